"""Renders images: colour, depth, geom ids and normals of a scene as a camera sees it."""

from __future__ import annotations

import dataclasses
import functools
from typing import NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from vsearch_jax.render import trace
from vsearch_jax.render.cameras import pinhole, pixel_rays, scale_resolution
from vsearch_jax.render.errors import RenderError
from vsearch_jax.render.geometry.projection import Pinhole, Projection
from vsearch_jax.render.geometry.rasterizer import Raster, rasterize
from vsearch_jax.render.light import shading
from vsearch_jax.render.light.lighting import (
    incidences,
    lit_by,
    needs_shadow_maps,
    shadow_maps,
)
from vsearch_jax.render.light.shadow_map import ShadowMap
from vsearch_jax.render.lights import LightPoses, light_poses
from vsearch_jax.render.mj_poses import GeomPoses
from vsearch_jax.render.pixels import resolve_surface
from vsearch_jax.render.scene import RenderScene
from vsearch_jax.render.texture import lookup
from vsearch_jax.render.tiling import Tiling
from vsearch_jax.types import Camera, Image
from vsearch_jax.xla.batching import map_in_batches
from vsearch_jax.xla.materialize import materialize, runtime_zero
from vsearch_jax.xla.trace_once import trace_once
from vsearch_jax.xla.vectors import Vector

# Height and width of a tile on a CPU. About forty planes of a batch of such tiles fit into the cache, and a tile has to
# visit fewer geoms than the whole image.
_CPU_TILE = (32, 64)
# The rasteriser keeps the columns and rows of a face in 16 bits.
_MAX_EDGE = 2**15 - 1

_Tile: TypeAlias = "tuple[tuple[Array, Array], Raster | trace.Hits | None, Array | None]"
"""One tile of the image: slopes of its rays, f32[1, w] and f32[h, 1]; what is known of its pixels; its shade.

What is known is the nearest face, or the geom that each pixel shows, or nothing. The shade is bool[h, w] or nothing.
"""


class _ImageContext(NamedTuple):
    """What all tiles of an image share.

    Attributes:
      frames: poses of the geoms relative to the camera.
      rotation: f32[3, 3], camera to world.
      lights: poses of the lights relative to the camera.
      shadows: shadow map of each light that casts shadows of faces, by the light's number.
      zero: i32[], see `materialize`.
    """

    frames: trace.Frames
    rotation: Array
    lights: LightPoses
    shadows: dict[int, ShadowMap]
    zero: Array


def render(
    scene: RenderScene, data: GeomPoses, camera: Camera, size: tuple[int, int], shade: Array | None = None
) -> Image:
    """Renders one image of a scene as a camera sees it: colour, depth, geom numbers, normals. Batch it with `jax.vmap`.

    Depth and geom_id equal those of C MuJoCo's `mj_ray` through the pixels' centres. Colours follow MuJoCo's light
    model, evaluated in every pixel. Shadows are sharp. Shadows of primitives are exact. Shadows of meshes and height
    fields come from one shadow map for each light. The map has as many cells as the image has pixels, and covers the
    visible part of the scene. There is no near or far plane.

    The camera and the lights must be outside all solids. From inside a solid, its wall is lit as from outside, and
    shadows are wrong. A camera or a geom with NaN in its pose is not an error: the image of such a camera shows nothing
    (depth +inf, geom_id -1), and such a geom is not drawn.

    Derivatives are those of the geom that each pixel shows. They are finite. They do not include the motion of outlines
    and of shadow edges; for outlines see `soft_silhouette`.

    Args:
      scene: shapes, materials and lights, from `compile_scene`.
      data: poses of the ngeom geoms: `mjx.Data`, `Poses`, or any object with the positions geom_xpos f32[ngeom, 3] m
        in world and the rotations geom_xmat f32[ngeom, 3, 3], geom to world. If bodies carry lights, also xpos
        f32[nbody, 3] m and xmat f32[nbody, 3, 3], body to world.
      camera: the camera in the world frame.
      size: height H and width W of the image in pixels, static.
      shade: bool[H, W], pixels that the lights which cast shadows do not reach, as if something outside of the scene
        stood between. None is no such pixel.

    Returns:
      Colour rgb f32[H, W, 3] in [0, 1]. Depth f32[H, W] m along the optical axis, +inf where the ray hits nothing.
      Number of the geom that is seen, geom_id i32[H, W], -1 on a miss. Surface normal f32[H, W, 3], unit vectors in
      world, 0 on a miss. Under jit, fields that are not used cost nothing.

    Raises:
      RenderError: height or width is not from 1 to 32,767.
    """
    if not all(0 < count <= _MAX_EDGE for count in size):
        raise RenderError(f"size is {size}; allowed: height and width from 1 to {_MAX_EDGE}")
    frames, lights = _camera_frames(scene, data, camera), light_poses(scene.lights, data, camera)
    return _draw(scene, frames, lights, camera, (size[0], size[1]), shade)


@trace_once("size")
def _draw(
    scene: RenderScene,
    frames: trace.Frames,
    lights: LightPoses,
    camera: Camera,
    size: tuple[int, int],
    shade: Array | None,
) -> Image:
    """Returns the image of a scene whose geoms and lights have the given poses relative to the camera."""
    tiling = _choose_tiling(size)
    zero = runtime_zero(frames.origin)
    pixels = pinhole(camera, size)
    # Without a fusion boundary, XLA computes the tangent and the matrix products again in every pixel.
    rotation, rays = camera.rotation, pixel_rays(pixels, size)
    frames, rotation, lights, pixels, rays = materialize((frames, rotation, lights, pixels, rays), zero)
    # Visibility has no derivatives.
    fixed_scene, fixed_frames, fixed_lights, fixed_pixels = jax.lax.stop_gradient((scene, frames, lights, pixels))
    raster = None
    if scene.triangles is not None:
        whole = _rasterize_faces(fixed_scene, fixed_frames, fixed_pixels, size, zero)
        raster = Raster(tiling.split(whole.depth), tiling.split(whole.face))
    tiles: _Tile = (tiling.split_axes(*rays), raster, None if shade is None else tiling.split(shade))
    shadows: dict[int, ShadowMap] = {}
    if needs_shadow_maps(scene):
        hits = jax.lax.map(functools.partial(_nearest_hits, fixed_scene, fixed_frames), jax.lax.stop_gradient(tiles))
        shadows = _cast_shadow_maps(fixed_scene, fixed_frames, fixed_lights, (tiles[0], hits), zero)
        tiles = (tiles[0], hits, tiles[2])
    context = _ImageContext(frames, rotation, lights, shadows, zero)
    images = jax.lax.map(functools.partial(_render_tile, scene, context), tiles)
    return jax.tree.map(tiling.join, images)


def render_batch(
    scene: RenderScene, data: GeomPoses, cameras: Camera, size: tuple[int, int], *, batch_size: int
) -> Image:
    """Renders one image for each camera, `batch_size` images at a time, to bound the memory.

    All images share the scene and the poses. If scene or poses differ from image to image, map your own function with
    `vsearch_jax.xla.batching.map_in_batches`.

    Args:
      scene: shapes, materials and lights, from `compile_scene`.
      data: poses of the geoms, as for `render`.
      cameras: N cameras in the world frame: a Camera with a leading axis N.
      size: height and width of an image in pixels, static.
      batch_size: number of images that are rendered at a time, static. Values above N count as N.

    Returns:
      The N images: an Image with a leading axis N, in the order of the cameras.

    Raises:
      RenderError: `batch_size` is not positive.
    """
    if batch_size < 1:
        raise RenderError(f"batch_size is {batch_size}; allowed: 1 or more")
    return map_in_batches(lambda camera: render(scene, data, camera, size), cameras, batch_size)


def supersample(scene: RenderScene, data: GeomPoses, camera: Camera, size: tuple[int, int], factor: int) -> Image:
    """Renders one image with anti-aliasing: the colour of a pixel is the mean of `factor` x `factor` rays.

    Args:
      scene: shapes, materials and lights, from `compile_scene`.
      data: poses of the geoms, as for `render`.
      camera: the camera in the world frame.
      size: height and width of the image in pixels, static.
      factor: number of rays along each edge of a pixel, odd, static. The cost grows with the square of `factor`.

    Returns:
      The image of `size`. Only the colour is a mean: depth, geom_id and normal are those of the ray through the centre
      of the pixel.

    Raises:
      RenderError: `factor` is even or not positive.
    """
    if factor < 1 or factor % 2 == 0:
        raise RenderError(f"factor is {factor}; allowed: 1, 3, 5, ... (one ray must go through the pixel's centre)")
    fine = render(scene, data, scale_resolution(camera, factor), (factor * size[0], factor * size[1]))
    rgb = fine.rgb.reshape(size[0], factor, size[1], factor, 3).mean(axis=(1, 3))
    middle = slice(factor // 2, None, factor)
    return dataclasses.replace(jax.tree.map(lambda plane: plane[middle, middle], fine), rgb=rgb)


def silhouette(image: Image, geom_ids: tuple[int, ...]) -> Array:
    """Returns the silhouette of some geoms: bool[H, W], true where a pixel shows one of them.

    Args:
      image: rendered image of H x W pixels.
      geom_ids: MuJoCo's numbers of the geoms, static. An empty tuple gives an empty silhouette.
    """
    ids = np.asarray(geom_ids, dtype=np.int32).reshape(-1)
    return jnp.any(image.geom_id[..., None] == ids[None, None], axis=-1)


def _choose_tiling(size: tuple[int, int]) -> Tiling:
    # A GPU is faster with one large tile. A program that is exported from a CPU to a GPU is correct, but slower.
    tile = _CPU_TILE if jax.default_backend() == "cpu" else size
    return Tiling(size, (min(tile[0], size[0]), min(tile[1], size[1])))


def _cast_shadow_maps(
    scene: RenderScene,
    frames: trace.Frames,
    lights: LightPoses,
    tiles: tuple[tuple[Array, Array], trace.Hits],
    zero: Array,
) -> dict[int, ShadowMap]:
    """Returns the shadow maps of all lights that need one; the arrays of `tiles` have a leading axis of tiles."""
    (x, y), hits = jax.lax.stop_gradient(tiles)
    seen = (x * hits.depth, y * hits.depth, -hits.depth), hits.is_hit
    return shadow_maps(scene, frames, lights, seen, zero)


def _nearest_hits(scene: RenderScene, frames: trace.Frames, tile: _Tile) -> trace.Hits:
    rays, known, _ = tile
    if isinstance(known, trace.Hits):
        return known
    hits = trace.nearest_primitives(scene, frames, *rays)
    return hits if known is None else trace.merge_raster(scene, hits, known)


def _render_tile(scene: RenderScene, context: _ImageContext, tile: _Tile) -> Image:
    """Returns the image of one tile. Its rgb and normal have the channel first: f32[3, h, w]."""
    rays, _, shade = tile
    zero = context.zero
    hits = _nearest_hits(*jax.lax.stop_gradient((scene, context.frames, tile)))
    depth, surface = resolve_surface(scene, context.frames, hits, rays, zero)
    hits = hits._replace(depth=depth)
    lit = lit_by(scene, context.frames, hits, rays, (context.lights, context.shadows), surface)
    if shade is not None:
        lit = {light: jnp.where(shade, 0.0, is_lit) for light, is_lit in lit.items()}
    channels = shading.shade(scene, surface, materialize(incidences(scene, context.lights, surface, rays, lit), zero))
    background = _background(scene, context, rays)
    rgb = [jnp.where(hits.is_hit, channel, b) for channel, b in zip(channels, background, strict=True)]
    geom_ids = jnp.asarray(scene.geom_ids, dtype=jnp.int32).at[hits.slot].get(mode="promise_in_bounds")
    return Image(
        rgb=jnp.stack(materialize(rgb, zero)),
        depth=jnp.where(hits.is_hit, depth, jnp.inf),
        geom_id=jnp.where(hits.is_hit, geom_ids, -1),
        normal=jnp.stack([jnp.where(hits.is_hit, axis, 0.0) for axis in trace.apply(context.rotation, surface.normal)]),
    )


def _background(scene: RenderScene, context: _ImageContext, rays: tuple[Array, Array]) -> Vector:
    """Returns red, green and blue of a miss: the sky's f32[h, w] each, or the uniform background's f32[] each."""
    uniform = (scene.background[0], scene.background[1], scene.background[2])
    if scene.textures is None or scene.textures.sky is None:
        return uniform
    return lookup.sky(scene.textures, trace.apply(context.rotation, (*rays, -jnp.ones_like(rays[0]))))


def _camera_frames(scene: RenderScene, data: GeomPoses, camera: Camera) -> trace.Frames:
    """Returns the poses of the visible geoms relative to the camera."""
    ids = np.asarray(scene.geom_ids)
    geom_rotation = data.geom_xmat.reshape(-1, 3, 3)[ids]
    offset = data.geom_xpos[ids] - camera.position[None]
    return trace.Frames(
        rotation=jnp.einsum("gji,jk->gik", geom_rotation, camera.rotation),
        origin=-jnp.einsum("gji,gj->gi", geom_rotation, offset),
        center=offset @ camera.rotation,
        radius=trace.bounding_radius(scene),
    )


def _rasterize_faces(
    scene: RenderScene, frames: trace.Frames, pixels: Pinhole, size: tuple[int, int], zero: Array
) -> Raster:
    """Returns the nearest face of each pixel, ignoring primitives."""
    triangles = scene.triangles
    assert triangles is not None
    origin = frames.origin[scene.num_primitives :]
    # From inside a closed mesh, its back faces are visible, so they must not be culled.
    is_outside = jnp.any((origin < triangles.low) | (origin > triangles.high), axis=1)
    pose = trace.pose_rows(frames, scene.num_primitives)
    is_culled = jnp.where(is_outside, triangles.is_closed, 0.0)
    return rasterize(triangles, Projection(pose, is_culled, pixels, False), size, zero)
