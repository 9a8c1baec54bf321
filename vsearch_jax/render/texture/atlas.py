"""The texture atlas: all textures of a MuJoCo model as one list of texels, and each geom's texture mapping.

A texture has one side (a 2D texture) or six (a cube map). Each side has a mipmap: a pyramid of images, each of half the
size of the one before. The mappings follow MuJoCo's renderer (render_gl3.c, `settexture`; render_context.c, `makePlane`
and `makeBuiltin`).
"""

from __future__ import annotations

from typing import NamedTuple

import flax.struct
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array
from mujoco import mjtGeom, mjtTexture, mjtTextureRole

from vsearch_jax.render.geometry.triangles import TRIANGLE_TYPES

# The source of a geom's texture coordinates:
# NO_TEXTURE: the geom has none.
# MESH: texture coordinates of the mesh's vertices.
# PLANAR: x and y of the point (for meshes without texture coordinates and height fields).
# CUBE: direction of the point, for a cube map.
# PRIMITIVE: MuJoCo's parametrisation of the primitive; see `render.texture.lookup`.
NO_TEXTURE, MESH, PLANAR, CUBE, PRIMITIVE = range(5)


@flax.struct.dataclass
class Textures:
    """All textures of a scene. X is the number of textures, L the number of mipmap levels, G the number of geoms.

    Attributes:
      texels: i32[N], all N texels of all textures; the low three bytes are red, green and blue.
      start: i32[X * 6 * L], index of the first texel of each image, by texture, side and level.
      width: f32[X] texels, width of level 0, the largest.
      height: f32[X] texels, height of level 0.
      texture: i32[G], row of each geom's texture; 0 if it has none.
      scale: f32[2, G]; texture coordinates are `scale` times the coordinates of the source, plus `shift`.
      shift: f32[2, G], added to the scaled coordinates.
      extent: f32[3, G] m; for a cube map, the direction is the point in the geom's frame divided by `extent`.
      modes: for each geom NO_TEXTURE, MESH, PLANAR, CUBE or PRIMITIVE; static.
      num_levels: L; static.
      sky: row of the skybox texture, or None; static.
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
    """Returns MuJoCo's id of the texture that colours a geom, or -1 if the geom has no such texture.

    Args:
      model: the compiled MuJoCo model.
      geom: MuJoCo's id of the geom.
    """
    material = int(model.geom_matid[geom])
    return -1 if material < 0 else int(model.mat_texid[material, mjtTextureRole.mjTEXROLE_RGB])


def compile_textures(model: mujoco.MjModel, geoms: np.ndarray) -> Textures | None:
    """Collects the textures of some geoms, and the model's first skybox, into one texture atlas for the renderer.

    Args:
      model: the compiled MuJoCo model.
      geoms: int[G], MuJoCo's ids of the G geoms that are drawn.

    Returns:
      The atlas, with the geoms in the given order. None if there are no textures.
    """
    geom_textures = [rgb_texture(model, g) for g in geoms]
    skyboxes = np.flatnonzero(model.tex_type == mjtTexture.mjTEXTURE_SKYBOX)
    used = sorted({t for t in geom_textures if t >= 0} | set(skyboxes[:1].tolist()))
    if not used:
        return None
    num_levels = int(max(model.tex_width[used].max(), model.tex_height[used].max())).bit_length()
    texels, start = _pack_texels([_sides(model, t) for t in used], num_levels)
    mappings = [_mapping(model, int(g)) for g in geoms]
    return Textures(
        texels=jnp.asarray(texels, dtype=jnp.int32),
        start=jnp.asarray(start, dtype=jnp.int32),
        width=_f32(model.tex_width[used]),
        height=_f32([_side_height(model, t) for t in used]),
        texture=jnp.asarray([used.index(t) if t >= 0 else 0 for t in geom_textures], dtype=jnp.int32),
        scale=_f32(np.stack([m.scale for m in mappings], axis=1)),
        shift=_f32(np.stack([m.shift for m in mappings], axis=1)),
        extent=_f32(np.stack([m.extent for m in mappings], axis=1)),
        modes=tuple(m.mode for m in mappings),
        num_levels=num_levels,
        sky=used.index(int(skyboxes[0])) if skyboxes.size else None,
    )


def _f32(values: np.ndarray | list) -> Array:
    return jnp.asarray(np.asarray(values), dtype=jnp.float32)


def _side_height(model: mujoco.MjModel, texture: int) -> int:
    is_flat = model.tex_type[texture] == mjtTexture.mjTEXTURE_2D
    return int(model.tex_height[texture] if is_flat else model.tex_width[texture])


def _sides(model: mujoco.MjModel, texture: int) -> np.ndarray:
    """Returns [1 or 6, h, w, 3] in [0, 255]: one image, or a cube map's right, left, up, down, front and back.

    The values are linear: u8, or f32 for a 2D texture in sRGB, which OpenGL decodes. It does not decode cube maps.
    """
    width, height = int(model.tex_width[texture]), int(model.tex_height[texture])
    channels, first = int(model.tex_nchannel[texture]), int(model.tex_adr[texture])
    image = model.tex_data[first : first + width * height * channels].reshape(height, width, channels)[..., :3]
    if model.tex_type[texture] == mjtTexture.mjTEXTURE_2D:
        is_srgb = model.tex_colorspace[texture] == mujoco.mjtColorSpace.mjCOLORSPACE_SRGB
        return _decoded_srgb()[image][None] if is_srgb else image[None]
    return image[None].repeat(6, axis=0) if width == height else image.reshape(6, width, width, 3)


def _decoded_srgb() -> np.ndarray:
    """Returns f32[256] in [0, 255], the linear value of each sRGB byte (IEC 61966-2-1)."""
    value = np.arange(256) / 255.0
    linear = np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)
    return (255.0 * linear).astype(np.float32)


def _next_level(sides: np.ndarray) -> np.ndarray:
    """Returns the next mipmap level, f32[sides, h, w, 3]: means over areas, so that the mean of the image stays.

    An even axis takes the means of two texels. On an odd axis of 2 m + 1 texels, each of the m new texels is the mean
    of an interval of 2 + 1 / m old ones.
    """
    return _halve(_halve(sides.astype(np.float32, copy=False), 1), 2)


def _halve(sides: np.ndarray, axis: int) -> np.ndarray:
    rows = np.moveaxis(sides, axis, 0)
    half = len(rows) // 2
    if half == 0:
        return sides
    if len(rows) % 2 == 0:
        result = 0.5 * (rows[0::2] + rows[1::2])
    else:
        weight = np.arange(1, half + 1, dtype=np.float32)[:, None, None, None] / len(rows)
        middle = np.float32(half / len(rows))
        result = weight[::-1] * rows[0:-1:2] + middle * rows[1::2] + weight * rows[2::2]
    return np.moveaxis(result, 0, axis)


def _pack_texels(textures: list[np.ndarray], num_levels: int) -> tuple[np.ndarray, np.ndarray]:
    """Returns `Textures.texels` and `Textures.start`. All six sides of a 2D texture are its one image."""
    texels, start, count = [], np.zeros((len(textures), 6, num_levels), np.int64), 0
    for index, level_0 in enumerate(textures):
        sides = level_0
        for level in range(num_levels):
            rounded = sides if sides.dtype == np.uint8 else np.round(sides).astype(np.uint8)
            packed = np.zeros(rounded.shape[:3], np.int32)
            for channel in range(3):
                packed |= rounded[..., channel].astype(np.int32) << 8 * channel
            for side in range(6):
                start[index, side, level] = count + (side % len(sides)) * packed[0].size
            texels.append(packed.reshape(-1))
            count += packed.size
            sides = _next_level(sides)
    return np.concatenate(texels), start.reshape(-1)


class _Mapping(NamedTuple):
    """The columns of one geom in `Textures.modes`, `scale`, `shift` and `extent`."""

    mode: int
    scale: np.ndarray
    shift: np.ndarray
    extent: np.ndarray


def _mapping(model: mujoco.MjModel, geom: int) -> _Mapping:
    """Returns the texture mapping of a geom (render_gl3.c, `settexture`)."""
    texture, kind, size = rgb_texture(model, geom), int(model.geom_type[geom]), model.geom_size[geom]
    if texture < 0:
        return _Mapping(NO_TEXTURE, np.ones(2), np.zeros(2), np.ones(3))
    material = int(model.geom_matid[geom])
    is_uniform, repeat = bool(model.mat_texuniform[material]), model.mat_texrepeat[material].astype(np.float64)
    half_sizes = _half_sizes(kind, size)
    if model.tex_type[texture] != mjtTexture.mjTEXTURE_2D:
        # MuJoCo draws primitives as scaled unit solids, but planes, meshes and height fields in metres.
        is_scaled = kind not in (*TRIANGLE_TYPES, int(mjtGeom.mjGEOM_PLANE))
        with np.errstate(divide="ignore"):  # along an endless axis, of size 0, OpenGL's direction does not change
            extent = np.where(is_scaled, half_sizes, 1.0) / (half_sizes if is_uniform else 1.0)
        return _Mapping(CUBE, np.ones(2), np.zeros(2), extent)
    stretch = np.where((half_sizes[:2] > 0.0) & is_uniform, half_sizes[:2], 1.0)
    has_texcoord = kind == mjtGeom.mjGEOM_MESH and model.mesh_texcoordadr[model.geom_dataid[geom]] >= 0
    if kind in TRIANGLE_TYPES and not has_texcoord:
        scale = 0.5 * repeat / np.where(half_sizes[:2] > 0.0, half_sizes[:2], 1.0) * stretch
        return _Mapping(PLANAR, scale * [1.0, -1.0], np.full(2, -0.5), np.ones(3))
    scale = np.where(repeat > 0.0, repeat, 1.0) * stretch
    is_infinite = kind == mjtGeom.mjGEOM_PLANE and np.any(size[:2] <= 0.0)
    mode = MESH if has_texcoord else PRIMITIVE
    return _Mapping(mode, scale, np.full(2, -0.5 if is_infinite else 0.0), np.ones(3))


def _half_sizes(kind: int, size: np.ndarray) -> np.ndarray:
    """Returns f64[3] m, half sizes of a geom along x, y and z; MuJoCo stores fewer numbers for round geoms."""
    if kind == mjtGeom.mjGEOM_SPHERE:
        return size[[0, 0, 0]]
    return size[[0, 0, 1]] if kind in (mjtGeom.mjGEOM_CAPSULE, mjtGeom.mjGEOM_CYLINDER) else np.array(size)
