"""Textures of a MuJoCo model as one list of texels, and how geoms wear them."""

from __future__ import annotations

import flax.struct
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array
from mujoco import mjtGeom, mjtTexture, mjtTextureRole

from vsearch_jax.render.geometry.triangles import TRIANGLE_TYPES

# How a geom finds its texel: from the coordinates of its faces, from its own frame, by direction, or by MuJoCo's
# coordinates of the primitives (render_context.c).
PLAIN, FACES, LINEAR, CUBE, PRIMITIVE = range(5)


@flax.struct.dataclass
class Textures:
    """All textures of a scene, each with its pyramid of halved pictures; X textures of six sides or one, L levels.

    Attributes:
      texels: i32[N], red, green and blue in the low three bytes.
      start: i32[X * 6 * L], where each picture's texels begin: by texture, side and level.
      width: f32[X], of the first level.
      height: f32[X].
      texture: i32[G], of each geom of the scene; 0 where it has none.
      scale: f32[2, G], from the geom's to the texture's coordinates.
      shift: f32[2, G].
      extent: f32[3, G], by which a point in the geom's frame is divided before it is a direction.
      modes: for each geom PLAIN, FACES, LINEAR, CUBE or PRIMITIVE; static.
      num_levels: L; static.
      sky: the texture of the sky, or None; static.
    """

    texels: Array
    start: Array
    width: Array
    height: Array
    texture: Array
    scale: Array
    shift: Array
    extent: Array
    modes: tuple[int, ...] = flax.struct.field(pytree_node=False)
    num_levels: int = flax.struct.field(pytree_node=False)
    sky: int | None = flax.struct.field(pytree_node=False)


def rgb_texture(model: mujoco.MjModel, geom: int) -> int:
    """Returns the texture that colours a geom, or -1."""
    material = int(model.geom_matid[geom])
    return -1 if material < 0 else int(model.mat_texid[material, mjtTextureRole.mjTEXROLE_RGB])


def compile_textures(model: mujoco.MjModel, geoms: np.ndarray) -> Textures | None:
    """Returns the textures of `geoms` and the sky, or None if there are none."""
    worn = [rgb_texture(model, g) for g in geoms]
    skies = np.flatnonzero(model.tex_type == mjtTexture.mjTEXTURE_SKYBOX)
    used = sorted({t for t in worn if t >= 0} | set(skies[:1].tolist()))
    if not used:
        return None
    num_levels = int(max(model.tex_width[used].max(), model.tex_height[used].max())).bit_length()
    texels, start = _atlas([_sides(model, t) for t in used], num_levels)
    mappings = [_mapping(model, int(g)) for g in geoms]
    return Textures(
        texels=jnp.asarray(texels, dtype=jnp.int32),
        start=jnp.asarray(start, dtype=jnp.int32),
        width=_f32(model.tex_width[used]),
        height=_f32([_side_height(model, t) for t in used]),
        texture=jnp.asarray([used.index(t) if t >= 0 else 0 for t in worn], dtype=jnp.int32),
        scale=_f32(np.stack([m[1] for m in mappings], axis=1)),
        shift=_f32(np.stack([m[2] for m in mappings], axis=1)),
        extent=_f32(np.stack([m[3] for m in mappings], axis=1)),
        modes=tuple(m[0] for m in mappings),
        num_levels=num_levels,
        sky=used.index(int(skies[0])) if skies.size else None,
    )


def _f32(values: np.ndarray | list) -> Array:
    return jnp.asarray(np.asarray(values), dtype=jnp.float32)


def _side_height(model: mujoco.MjModel, texture: int) -> int:
    is_flat = model.tex_type[texture] == mjtTexture.mjTEXTURE_2D
    return int(model.tex_height[texture] if is_flat else model.tex_width[texture])


def _sides(model: mujoco.MjModel, texture: int) -> np.ndarray:
    """Returns f64[1 or 6, h, w, 3], one picture or the six of a cube: right, left, up, down, front, back."""
    width, height = int(model.tex_width[texture]), int(model.tex_height[texture])
    channels, first = int(model.tex_nchannel[texture]), int(model.tex_adr[texture])
    picture = model.tex_data[first : first + width * height * channels].reshape(height, width, channels)[..., :3]
    if model.tex_type[texture] == mjtTexture.mjTEXTURE_2D:
        return picture[None].astype(np.float64)
    sides = picture[None].repeat(6, axis=0) if width == height else picture.reshape(6, width, width, 3)
    return sides.astype(np.float64)


def _halved(sides: np.ndarray) -> np.ndarray:
    """Returns the next level: means of 2 x 2 texels; an odd last row or column goes into none."""
    for axis in (1, 2):
        count = sides.shape[axis]
        if count > 1:
            even, odd = (np.take(sides, range(i, count // 2 * 2, 2), axis=axis) for i in (0, 1))
            sides = 0.5 * (even + odd)
    return sides


def _atlas(textures: list[np.ndarray], num_levels: int) -> tuple[np.ndarray, np.ndarray]:
    """Returns `Textures.texels` and `Textures.start`."""
    texels, start, count = [], np.zeros((len(textures), 6, num_levels), np.int64), 0
    for index, picture in enumerate(textures):
        sides = picture
        for level in range(num_levels):
            whole = np.round(sides).astype(np.int64)
            packed = whole[..., 0] | whole[..., 1] << 8 | whole[..., 2] << 16
            for side in range(6):
                start[index, side, level] = count + (side % len(sides)) * packed[0].size
            texels.append(packed.reshape(-1))
            count += packed.size
            sides = _halved(sides)
    return np.concatenate(texels), start.reshape(-1)


def _mapping(model: mujoco.MjModel, geom: int) -> tuple[int, np.ndarray, np.ndarray, np.ndarray]:
    """Returns the mode, and scale, shift and extent of `Textures` (render_gl3.c, settexture)."""
    texture, kind, size = rgb_texture(model, geom), int(model.geom_type[geom]), model.geom_size[geom]
    plain = PLAIN, np.ones(2), np.zeros(2), np.ones(3)
    if texture < 0:
        return plain
    material = int(model.geom_matid[geom])
    is_uniform, repeat = bool(model.mat_texuniform[material]), model.mat_texrepeat[material].astype(np.float64)
    # Primitives are drawn as scaled unit solids; planes, meshes and height fields as they are. MuJoCo takes the
    # radius of a capsule or a cylinder for its size along x and y, that of a sphere for all three.
    is_sized = kind not in (*TRIANGLE_TYPES, int(mjtGeom.mjGEOM_PLANE))
    whole = _whole_size(kind, size)
    if model.tex_type[texture] != mjtTexture.mjTEXTURE_2D:
        return CUBE, np.ones(2), np.zeros(2), np.where(is_sized, whole, 1.0) / (whole if is_uniform else 1.0)
    stretch = np.where((whole[:2] > 0.0) & is_uniform, whole[:2], 1.0)
    has_texcoord = kind == mjtGeom.mjGEOM_MESH and model.mesh_texcoordadr[model.geom_dataid[geom]] >= 0
    if kind in TRIANGLE_TYPES and not has_texcoord:
        scale = 0.5 * repeat / np.where(whole[:2] > 0.0, whole[:2], 1.0) * stretch
        return LINEAR, scale * [1.0, -1.0], np.full(2, -0.5), np.ones(3)
    scale = np.where(repeat > 0.0, repeat, 1.0) * stretch
    is_endless = kind == mjtGeom.mjGEOM_PLANE and np.any(size[:2] <= 0.0)
    return (FACES if has_texcoord else PRIMITIVE), scale, np.full(2, -0.5 if is_endless else 0.0), np.ones(3)


def _whole_size(kind: int, size: np.ndarray) -> np.ndarray:
    if kind == mjtGeom.mjGEOM_SPHERE:
        return size[[0, 0, 0]]
    return size[[0, 0, 1]] if kind in (mjtGeom.mjGEOM_CAPSULE, mjtGeom.mjGEOM_CYLINDER) else np.array(size)
