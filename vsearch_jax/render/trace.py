"""Finds the nearest primitive of each pixel, and the pixels that a light reaches.

Both passes loop over the geoms, type by type. Each type has one small loop body. A loop visits only the geoms that can
affect the image, so its length is known at run time only. Under `vmap` the longest loop of the batch counts.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from mujoco import mjtGeom

from vsearch_jax.render.geometry.rasterizer import Raster
from vsearch_jax.render.geometry.rays import CHORD_FUNCTIONS, RAY_FUNCTIONS
from vsearch_jax.render.scene import RenderScene
from vsearch_jax.xla.vectors import Vector, dot

_INFINITY_BITS = 0x7F800000  # bit pattern of +inf in f32


class Frames(NamedTuple):
    """Poses of the G visible geoms relative to the camera.

    Attributes:
      rotation: f32[G, 3, 3], camera to geom.
      origin: f32[G, 3] m, position of the camera in the geom's frame.
      center: f32[G, 3] m, position of the geom in the camera's frame.
      radius: f32[G] m, radius of the bounding sphere around `center`; +inf for planes.
    """

    rotation: Array
    origin: Array
    center: Array
    radius: Array


class Hits(NamedTuple):
    """The geom that each pixel of an H x W image shows: the nearest one on the pixel's ray.

    Attributes:
      slot: i32[H, W], row of the geom in the scene; 0 on a miss.
      depth: f32[H, W] m along the optical axis; 1 on a miss. `nearest_primitives` returns rough depths: their low bits
        hold the row of the geom.
      is_hit: bool[H, W], whether the pixel shows a geom.
      face: i32[H, W], column of the face in `Triangles.surface`, if the geom is made of triangles; 0 otherwise.
    """

    slot: Array
    depth: Array
    is_hit: Array
    face: Array


def type_starts(scene: RenderScene) -> tuple[tuple[int, int], ...]:
    """Returns (mjtGeom, row of its first geom) for each geom type in the scene, without meshes and height fields."""
    kinds = scene.geom_types[: scene.num_primitives]
    return tuple((kind, kinds.index(kind)) for kind in sorted(set(kinds)))


def bounding_radius(scene: RenderScene) -> Array:
    """Returns the radii of bounding spheres around the G visible geoms' origins, f32[G] m; +inf for planes."""
    x, y, z = scene.size[:, 0], scene.size[:, 1], scene.size[:, 2]
    radii = {
        "mjGEOM_PLANE": jnp.full_like(x, jnp.inf),
        "mjGEOM_SPHERE": x,
        "mjGEOM_CAPSULE": x + y,
        "mjGEOM_ELLIPSOID": jnp.maximum(jnp.maximum(x, y), z),
        "mjGEOM_CYLINDER": jnp.sqrt(x * x + y * y),
        "mjGEOM_BOX": jnp.sqrt(x * x + y * y + z * z),
    }
    kinds = scene.geom_types[: scene.num_primitives]
    primitives = [radii[mjtGeom(kind).name][row] for row, kind in enumerate(kinds)]
    others = [] if scene.triangles is None else [*scene.triangles.radius]
    return jnp.stack(primitives + others)


def apply(rotation: Array, vector: Vector, offset: Array | None = None) -> Vector:
    """Rotates and shifts vectors that are stored as three arrays x, y, z: `rotation @ vector + offset`.

    Args:
      rotation: f32[3, 3].
      vector: x, y and z of the vectors: three arrays of one shape, or of shapes that broadcast.
      offset: f32[3], or None for zero.

    Returns:
      x, y and z of the results: three arrays.
    """
    rows = [rotation[i, 0] * vector[0] + rotation[i, 1] * vector[1] + rotation[i, 2] * vector[2] for i in range(3)]
    if offset is not None:
        rows = [row + offset[i] for i, row in enumerate(rows)]
    return rows[0], rows[1], rows[2]


def _as_vector(array: Array) -> Vector:
    return array[0], array[1], array[2]


def _has_next_geom(rank: Array, state: tuple[Array, Array]) -> Array:
    return state[0] < rank[-1]


def _visit_geom(
    value: Callable[[int, Array], Array], kind: int, start: int, rank: Array, state: tuple[Array, Array]
) -> tuple[Array, Array]:
    """Takes the minimum with the next kept geom; the rank of a geom counts the kept geoms up to it."""
    count, best = state
    row = start + jnp.argmax(rank == count + 1)
    return count + 1, jnp.minimum(best, value(kind, row))


def _minimum_over_geoms(
    scene: RenderScene, is_kept: Array, value: Callable[[int, Array], Array], initial: Array
) -> Array:
    """Returns the pixelwise minimum of `initial` and `value(type, row)` over the primitives where `is_kept`."""
    best = initial
    for (kind, start), (_, stop) in itertools.pairwise((*type_starts(scene), (-1, scene.num_primitives))):
        rank = jnp.cumsum(is_kept[start:stop])
        visit = functools.partial(_visit_geom, value, kind, start, rank)
        _, best = jax.lax.while_loop(functools.partial(_has_next_geom, rank), visit, (jnp.zeros_like(rank[0]), best))
    return best


def _is_in_frustum(frames: Frames, x: Array, y: Array) -> Array:
    """Returns bool[G]: the geom's bounding sphere intersects the view frustum of the pixels."""
    depth = -frames.center[:, 2]
    is_kept = depth > -frames.radius
    for axis, slopes in ((0, x), (1, y)):
        for slope, side in ((jnp.max(slopes), 1.0), (jnp.min(slopes), -1.0)):
            outside = side * (frames.center[:, axis] - slope * depth)
            is_kept &= outside < frames.radius * jnp.sqrt(1.0 + slope * slope)
    return is_kept


def nearest_primitives(scene: RenderScene, frames: Frames, x: Array, y: Array) -> Hits:
    """Finds the primitive geom (not a mesh or height field) that each pixel of an H x W image shows.

    The low bits of the depth hold the row of the geom. Bit patterns of positive floats have the order of the floats, so
    one minimum finds depth and row. Two surfaces are confused if their depths differ by less than the lost bits: 1e-5
    of the depth with 64 primitives, 1e-4 with 1,000.

    Args:
      scene: the compiled scene; the shapes are read.
      frames: poses of the geoms relative to the camera.
      x: f32[1, W], x of the directions (x, y, -1) of the pixels' rays, in the camera's frame.
      y: f32[H, 1], y of these directions.

    Returns:
      Nearest primitive of each pixel, with a rough depth.
    """
    mask = (1 << max(1, (scene.num_primitives - 1).bit_length())) - 1
    ray = (x, y, -jnp.ones_like(x))

    def packed_depth(kind: int, row: Array) -> Array:
        direction = apply(frames.rotation[row], ray)
        depth = RAY_FUNCTIONS[kind](_as_vector(scene.size[row]), _as_vector(frames.origin[row]), direction)
        return (jax.lax.bitcast_convert_type(depth, jnp.int32) & ~mask) | row.astype(jnp.int32)

    initial = jnp.full((y.shape[0], x.shape[1]), _INFINITY_BITS, dtype=jnp.int32)
    packed = _minimum_over_geoms(scene, _is_in_frustum(frames, x, y), packed_depth, initial)
    is_hit = packed < _INFINITY_BITS
    depth = jax.lax.bitcast_convert_type(packed & ~mask, jnp.float32)
    slot = jnp.where(is_hit, packed & mask, 0)
    return Hits(slot, jnp.where(is_hit, depth, 1.0), is_hit, jnp.zeros_like(slot))


def pose_rows(frames: Frames, start: int) -> Array:
    """Returns the poses of the scene's last geoms in the layout that the rasteriser of meshes and height fields reads.

    Args:
      frames: poses of the G visible geoms relative to the camera.
      start: row of the first geom to return, static.

    Returns:
      f32[12, G - start]. A column holds the 3 x 4 matrix from the geom's frame to the camera's frame, row by row, in m.
    """
    rotation = frames.rotation[start:].transpose(0, 2, 1)
    return jnp.concatenate([rotation, frames.center[start:, :, None]], axis=2).reshape(-1, 12).T


def merge_raster(scene: RenderScene, hits: Hits, raster: Raster) -> Hits:
    """Combines both passes of the renderer: keeps for each pixel the nearer of its primitive geom and its triangle.

    Args:
      scene: the compiled scene, with meshes or height fields.
      hits: nearest primitive of each pixel.
      raster: nearest triangle of each pixel.
    """
    assert scene.triangles is not None
    is_nearer = raster.depth < jnp.where(hits.is_hit, hits.depth, jnp.inf)
    geom = scene.triangles.geom.at[raster.face].get(mode="promise_in_bounds")
    face = raster.face
    if scene.triangles.is_shared:
        face = face + scene.triangles.shift.at[geom].get(mode="promise_in_bounds")
    return Hits(
        jnp.where(is_nearer, scene.num_primitives + geom, hits.slot),
        jnp.where(is_nearer, raster.depth, hits.depth),
        hits.is_hit | is_nearer,
        jnp.where(is_nearer, face, 0),
    )


def is_lit(
    scene: RenderScene,
    frames: Frames,
    hits: Hits,
    rays: tuple[Array, Array],
    light: Array,
    is_directional: bool,
) -> Array:
    """Computes which pixels of an H x W image a light reaches. Only primitive geoms cast shadows here, not meshes.

    A primitive is convex, so it never casts a shadow on the part of itself that faces the light. Each pixel therefore
    skips its own geom, and needs no bias against self-shadowing. Assumes that the light and the visible surfaces lie
    outside all other solids.

    Args:
      scene: the compiled scene; the shapes are read.
      frames: poses of the geoms relative to the camera.
      hits: geom that each pixel shows, with exact depth.
      rays: x f32[1, W] and y f32[H, 1] of the directions (x, y, -1) of the pixels' rays, in the camera's frame.
      light: f32[3] in the camera's frame: position of the light in m, or unit vector towards a directional light.
      is_directional: whether the light is directional, static.

    Returns:
      f32[H, W], 0 where a primitive stands between the surface and the light, 1 elsewhere.
    """
    x, y = rays
    point = (x * hits.depth, y * hits.depth, -hits.depth)
    # A ray runs from the surface to a directional light, but from any other light to the surface. What all rays share,
    # the direction or the origin, is then computed only once.
    if is_directional:
        start, direction, low, high = point, _as_vector(light), scene.shadow_offset, jnp.full_like(hits.depth, jnp.inf)
    else:
        start, direction = _as_vector(light), (point[0] - light[0], point[1] - light[1], point[2] - light[2])
        low, high = 0.0, 1.0 - scene.shadow_offset / jnp.sqrt(jnp.maximum(dot(direction, direction), 1e-12))

    def lit_behind(kind: int, row: Array) -> Array:
        local_start = apply(frames.rotation[row], start, frames.origin[row])
        local_direction = apply(frames.rotation[row], direction)
        chord = CHORD_FUNCTIONS[kind](_as_vector(scene.size[row]), local_start, local_direction)
        return jnp.where((chord > low) & (chord < high) & (hits.slot != row), 0.0, 1.0)

    is_kept = _may_cast_shadow(frames, hits, rays, light, is_directional)
    return _minimum_over_geoms(scene, is_kept, lit_behind, jnp.ones_like(hits.depth))


def _may_cast_shadow(
    frames: Frames, hits: Hits, rays: tuple[Array, Array], light: Array, is_directional: bool
) -> Array:
    """Returns bool[G]: the geom's bounding sphere intersects a hull of all hit points and the light."""
    near = jnp.min(jnp.where(hits.is_hit, hits.depth, jnp.inf))
    far = jnp.max(jnp.where(hits.is_hit, hits.depth, -jnp.inf))
    near, far = jnp.where(near <= far, near, 1.0), jnp.where(near <= far, far, 1.0)
    # The hit points lie in a frustum between the depths `near` and `far`. A sphere around the middle of its axis bounds
    # the frustum.
    middle = 0.5 * (near + far)
    x_middle, y_middle = (0.5 * (jnp.min(slopes) + jnp.max(slopes)) for slopes in rays)
    x_half, y_half = (0.5 * (jnp.max(slopes) - jnp.min(slopes)) for slopes in rays)
    center = middle * jnp.stack([x_middle, y_middle, -jnp.ones_like(middle)])
    axis_length = jnp.sqrt(1.0 + x_middle * x_middle + y_middle * y_middle)
    limit = frames.radius + (far - middle) * axis_length + far * jnp.sqrt(x_half * x_half + y_half * y_half)
    # The hull lies within the sphere's radius of the line from the sphere's centre to the light.
    to_light = light if is_directional else light - center
    offset = frames.center - center[None]
    along = jnp.maximum(offset @ to_light / jnp.maximum(to_light @ to_light, 1e-20), 0.0)
    along = along if is_directional else jnp.minimum(along, 1.0)
    gap = offset - along[:, None] * to_light[None]
    return jnp.sum(gap * gap, axis=-1) <= limit * limit
