"""`render`: one image from what the other modules of this package do."""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from vsearch_jax.render import trace
from vsearch_jax.render.cameras import magnified, pinhole, pixel_rays
from vsearch_jax.render.geometry.rasterizer import Pinhole, Raster, View, rasterize
from vsearch_jax.render.light import shading
from vsearch_jax.render.light.lighting import (
    LightPoses,
    incidences,
    light_poses,
    lit_by,
    needs_shadow_maps,
    shadow_maps,
)
from vsearch_jax.render.light.shadow_map import ShadowMap
from vsearch_jax.render.pixels import surface_of
from vsearch_jax.render.scene import RenderError, RenderScene
from vsearch_jax.render.texture import lookup
from vsearch_jax.render.tiling import Tiling
from vsearch_jax.types import Camera, Image
from vsearch_jax.xla.batching import map_in_batches
from vsearch_jax.xla.materialize import materialize, runtime_zero

# Height and width of the part of an image that is drawn at a time on a CPU: the some forty planes of a batch of such
# parts stay in its cache, and a part meets fewer geoms than the whole.
_CPU_TILE = (32, 64)
# Along an edge of an image: columns and rows of a face are kept in 16 bits.
_MOST_PIXELS = 2**15 - 1


# Slopes of the rays of one part of the image, f32[1, w] and f32[h, 1], and the faces seen there.
_Tile = tuple[tuple[Array, Array], Raster | None]


class _Sight(NamedTuple):
    """What all parts of the image share."""

    frames: trace.Frames
    rotation: Array
    lights: LightPoses
    shadows: dict[int, ShadowMap]
    zero: Array


def render(scene: RenderScene, data: Any, camera: Camera, size: tuple[int, int]) -> Image:
    """Returns what `camera` sees.

    Depth and geom_id are those of C MuJoCo's `mj_ray` through the pixels' centres; colours follow MuJoCo's light model,
    evaluated in every pixel, with sharp shadows: those of primitives are exact, those of meshes and height fields as
    fine as one map of as many cells as the image has pixels, for the part of all of them that is seen. There is no near
    or far plane. Light and camera belong outside of all solids: a wall seen from inside is lit as from outside, and
    shadows in there are not right. Derivatives are those of the geom that each pixel shows: finite, and blind to
    outlines and to the edges of shadows.

    Args:
      scene: RenderScene.
      data: mjx.Data, Poses, or anything with geom_xpos f32[ngeom, 3] m and geom_xmat f32[ngeom, 3, 3], geom to world,
        and, if bodies carry lights, xpos and xmat likewise.
      camera: Camera.
      size: height and width in pixels, static.

    Returns:
      Image of that size. What is not used of it costs nothing inside jit. Its depth is NaN where meshes cover the image
      so many times that the pairs of face and pixel can't be counted in 31 bits.

    Raises:
      RenderError: an edge of the image has no pixel or more than 32,767.
    """
    if not all(0 < count <= _MOST_PIXELS for count in size):
        raise RenderError(f"size is {size}; allowed: height and width from 1 to {_MOST_PIXELS}")
    # A GPU would rather have everything at once. A program exported to another platform is right there, if slower.
    part = _CPU_TILE if jax.default_backend() == "cpu" else size
    tiling = Tiling(size, (min(part[0], size[0]), min(part[1], size[1])))
    frames, lights = _frames(scene, data, camera), light_poses(scene, data, camera)
    zero = runtime_zero(frames.origin)
    pixels = pinhole(camera, size)
    # Else the tangent and the products behind these would be computed anew in every pixel.
    rotation, rays = camera.rotation, pixel_rays(pixels, size)
    frames, rotation, lights, pixels, rays = materialize((frames, rotation, lights, pixels, rays), zero)
    fixed_scene, fixed_frames, fixed_lights, fixed_pixels = jax.lax.stop_gradient((scene, frames, lights, pixels))
    raster, shadows = None, {}
    if scene.triangles is not None:
        whole = _raster(fixed_scene, fixed_frames, fixed_pixels, size, zero)
        raster = Raster(tiling.split(whole.depth), tiling.split(whole.face))
    tiles = (tiling.split_axes(*rays), raster)
    if needs_shadow_maps(scene):
        (x, y), _ = fixed_tiles = jax.lax.stop_gradient(tiles)
        hits = jax.lax.map(functools.partial(_hits, fixed_scene, fixed_frames), fixed_tiles)
        seen = (x * hits.depth, y * hits.depth, -hits.depth), hits.is_hit
        shadows = shadow_maps(fixed_scene, fixed_frames, fixed_lights, seen, zero)
    sight = _Sight(frames, rotation, lights, shadows, zero)
    parts = jax.lax.map(functools.partial(_render_tile, scene, sight), tiles)
    return jax.tree.map(tiling.join, parts)


def render_batch(scene: RenderScene, data: Any, cameras: Camera, size: tuple[int, int], *, batch_size: int) -> Image:
    """Returns what each of `cameras` sees, drawn `batch_size` at a time, so that any number fits into memory.

    Where poses or the scene differ from image to image, `batches.map_in_batches` over a function of yours does the same.

    Args:
      scene: RenderScene.
      data: see `render`.
      cameras: Camera with a leading axis N.
      size: height and width in pixels, static.
      batch_size: images at a time, static; more than N is N.

    Returns:
      Image with a leading axis N.

    Raises:
      RenderError: `batch_size` is not positive.
    """
    if batch_size < 1:
        raise RenderError(f"batch_size is {batch_size}; allowed: 1 or more")
    return map_in_batches(lambda camera: render(scene, data, camera, size), cameras, batch_size)


def silhouette(image: Image, geom_ids: tuple[int, ...]) -> Array:
    """Returns bool[H, W]: the pixel shows one of the geoms `geom_ids` (MuJoCo's numbers)."""
    ids = np.asarray(geom_ids, dtype=np.int32).reshape(-1)
    return jnp.any(image.geom_id[..., None] == ids[None, None], axis=-1)


def _hits(scene: RenderScene, frames: trace.Frames, tile: _Tile) -> trace.Hits:
    rays, raster = tile
    hits = trace.nearest(scene, frames, *rays)
    return hits if raster is None else trace.nearer(scene, hits, raster)


def _render_tile(scene: RenderScene, sight: _Sight, tile: _Tile) -> Image:
    """Returns the image of one part of the pixels; its rgb and normal are f32[3, h, w]."""
    rays, zero = tile[0], sight.zero
    hits = _hits(*jax.lax.stop_gradient((scene, sight.frames, tile)))
    depth, surface = surface_of(scene, sight.frames, hits, rays, zero)
    hits = hits._replace(depth=depth)
    lit = lit_by(scene, sight.frames, hits, rays, (sight.lights, sight.shadows), surface)
    channels = shading.shade(scene, surface, materialize(incidences(scene, sight.lights, surface, rays, lit), zero))
    behind = (scene.background[0], scene.background[1], scene.background[2])
    if scene.textures is not None and scene.textures.sky is not None:
        behind = lookup.sky(scene.textures, trace.apply(sight.rotation, (*rays, -jnp.ones_like(rays[0]))))
    rgb = [jnp.where(hits.is_hit, channel, b) for channel, b in zip(channels, behind, strict=True)]
    geom_ids = jnp.asarray(scene.geom_ids, dtype=jnp.int32).at[hits.slot].get(mode="promise_in_bounds")
    return Image(
        rgb=jnp.stack(materialize(rgb, zero)),
        depth=jnp.where(hits.is_hit, depth, jnp.inf),
        geom_id=jnp.where(hits.is_hit, geom_ids, -1),
        normal=jnp.stack([jnp.where(hits.is_hit, axis, 0.0) for axis in trace.apply(sight.rotation, surface.normal)]),
    )


def supersample(scene: RenderScene, data: Any, camera: Camera, size: tuple[int, int], factor: int) -> Image:
    """Returns what `render` does, with the colour of each pixel the mean of `factor` x `factor` rays.

    Depth, geom_id and normal are those of the middle ray.

    Args:
      scene: RenderScene.
      data: see `render`.
      camera: Camera.
      size: height and width in pixels, static.
      factor: odd, static; the cost grows with its square.

    Raises:
      RenderError: `factor` is even or not positive.
    """
    if factor < 1 or factor % 2 == 0:
        raise RenderError(f"factor is {factor}; it must be 1, 3, 5, ..., so that one ray goes through a pixel's centre")
    fine = render(scene, data, magnified(camera, factor), (factor * size[0], factor * size[1]))
    rgb = fine.rgb.reshape(size[0], factor, size[1], factor, 3).mean(axis=(1, 3))
    middle = slice(factor // 2, None, factor)
    return jax.tree.map(lambda plane: plane[middle, middle], fine).replace(rgb=rgb)


def _frames(scene: RenderScene, data: Any, camera: Camera) -> trace.Frames:
    ids = np.asarray(scene.geom_ids)
    geom_rotation = data.geom_xmat.reshape(-1, 3, 3)[ids]
    offset = data.geom_xpos[ids] - camera.position[None]
    return trace.Frames(
        rotation=jnp.einsum("gji,jk->gik", geom_rotation, camera.rotation),
        origin=-jnp.einsum("gji,gj->gi", geom_rotation, offset),
        center=offset @ camera.rotation,
        radius=trace.bounding_radius(scene),
    )


def _raster(scene: RenderScene, frames: trace.Frames, pixels: Pinhole, size: tuple[int, int], zero: Array) -> Raster:
    """Returns the faces that the camera sees, were there nothing else."""
    triangles = scene.triangles
    assert triangles is not None
    origin = frames.origin[scene.num_primitives :]
    is_outside = jnp.any((origin < triangles.low) | (origin > triangles.high), axis=1)
    pose = trace.poses(frames, scene.num_primitives)
    return rasterize(triangles, View(pose, jnp.where(is_outside, triangles.is_closed, 0.0), pixels, False), size, zero)
