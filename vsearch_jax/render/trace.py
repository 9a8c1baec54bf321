"""Which geom each pixel sees, and which pixels a light reaches.

Both passes run through the geoms one by one, type by type, in loops that hold one small program a type. A loop visits
only the geoms that can matter to the image, so its length is found at run time; under `vmap` it is that of the image
with the most.
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

_INFINITY_BITS = 0x7F800000


class Frames(NamedTuple):
    """Where the geoms are as the camera sees them; G is the number of visible geoms.

    Attributes:
      rotation: f32[G, 3, 3], camera to geom.
      origin: f32[G, 3] m, the camera's position in the geom's frame.
      center: f32[G, 3] m, the geom's position in the camera's frame.
      radius: f32[G] m, of the sphere around `center` that holds the geom; +inf for planes.
    """

    rotation: Array
    origin: Array
    center: Array
    radius: Array


class Hits(NamedTuple):
    """The nearest geom of each pixel.

    Attributes:
      slot: i32[H, W], row of the geom in the scene; 0 on a miss.
      depth: f32[H, W] m; 1 on a miss. From `nearest` it is exact up to the bits that held the row.
      is_hit: bool[H, W].
      face: i32[H, W], the face that is hit, where it is one; 0 elsewhere.
    """

    slot: Array
    depth: Array
    is_hit: Array
    face: Array


def type_starts(scene: RenderScene) -> tuple[tuple[int, int], ...]:
    """Returns each type of primitive of the scene with its first row."""
    kinds = scene.geom_types[: scene.num_primitives]
    return tuple((kind, kinds.index(kind)) for kind in sorted(set(kinds)))


def bounding_radius(scene: RenderScene) -> Array:
    """Returns f32[G] m: radii of spheres around the geoms; +inf for planes."""
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
    """Returns the triple `rotation @ vector + offset`; `rotation` f32[3, 3], `offset` f32[3]."""
    rows = [rotation[i, 0] * vector[0] + rotation[i, 1] * vector[1] + rotation[i, 2] * vector[2] for i in range(3)]
    if offset is not None:
        rows = [row + offset[i] for i, row in enumerate(rows)]
    return rows[0], rows[1], rows[2]


def _triple(vector: Array) -> Vector:
    return vector[0], vector[1], vector[2]


def _is_left(rank: Array, state: tuple[Array, Array]) -> Array:
    return state[0] < rank[-1]


def _visit(
    value: Callable[[int, Array], Array], kind: int, start: int, rank: Array, state: tuple[Array, Array]
) -> tuple[Array, Array]:
    count, best = state
    row = start + jnp.argmax(rank == count + 1)
    return count + 1, jnp.minimum(best, value(kind, row))


def _minimum_over_geoms(
    scene: RenderScene, is_kept: Array, value: Callable[[int, Array], Array], initial: Array
) -> Array:
    """Returns the pixelwise minimum of `initial` and `value(type, row)` over the rows where `is_kept`."""
    best = initial
    for (kind, start), (_, stop) in itertools.pairwise((*type_starts(scene), (-1, scene.num_primitives))):
        rank = jnp.cumsum(is_kept[start:stop])
        visit = functools.partial(_visit, value, kind, start, rank)
        _, best = jax.lax.while_loop(functools.partial(_is_left, rank), visit, (jnp.zeros_like(rank[0]), best))
    return best


def _in_view(frames: Frames, x: Array, y: Array) -> Array:
    """Returns bool[G]: the geom's bounding sphere reaches into the pyramid that the pixels see."""
    depth = -frames.center[:, 2]
    is_kept = depth > -frames.radius
    for axis, slopes in ((0, x), (1, y)):
        for slope, side in ((jnp.max(slopes), 1.0), (jnp.min(slopes), -1.0)):
            outside = side * (frames.center[:, axis] - slope * depth)
            is_kept &= outside < frames.radius * jnp.sqrt(1.0 + slope * slope)
    return is_kept


def nearest(scene: RenderScene, frames: Frames, x: Array, y: Array) -> Hits:
    """Returns the nearest primitive of each pixel.

    The row number stands in the low bits of the depth's bit pattern. Bit patterns order as the depths do, so that one
    minimum finds both. Surfaces nearer to one another than these bits tell, 1e-5 of their depth with 64 primitives and
    1e-4 with 1,000, may be mistaken for one another.

    Args:
      scene: shapes.
      frames: Frames.
      x: f32[1, W], slopes of the pixels' rays.
      y: f32[H, 1].
    """
    mask = (1 << max(1, (scene.num_primitives - 1).bit_length())) - 1
    ray = (x, y, -jnp.ones_like(x))

    def packed_depth(kind: int, row: Array) -> Array:
        direction = apply(frames.rotation[row], ray)
        depth = RAY_FUNCTIONS[kind](_triple(scene.size[row]), _triple(frames.origin[row]), direction)
        return (jax.lax.bitcast_convert_type(depth, jnp.int32) & ~mask) | row.astype(jnp.int32)

    initial = jnp.full((y.shape[0], x.shape[1]), _INFINITY_BITS, dtype=jnp.int32)
    packed = _minimum_over_geoms(scene, _in_view(frames, x, y), packed_depth, initial)
    is_hit = packed < _INFINITY_BITS
    depth = jax.lax.bitcast_convert_type(packed & ~mask, jnp.float32)
    slot = jnp.where(is_hit, packed & mask, 0)
    return Hits(slot, jnp.where(is_hit, depth, 1.0), is_hit, jnp.zeros_like(slot))


def poses(frames: Frames, start: int) -> Array:
    """Returns f32[12, G - start]: the poses of the geoms from row `start` on, as `raster.View` has them."""
    rotation = frames.rotation[start:].transpose(0, 2, 1)
    return jnp.concatenate([rotation, frames.center[start:, :, None]], axis=2).reshape(-1, 12).T


def nearer(scene: RenderScene, hits: Hits, raster: Raster) -> Hits:
    """Returns the hits with those faces of `raster` that are nearer."""
    assert scene.triangles is not None
    is_nearer = ~(raster.depth >= jnp.where(hits.is_hit, hits.depth, jnp.inf))  # also of NaN, which is to be seen
    geom = scene.triangles.geom.at[raster.face].get(mode="promise_in_bounds")
    return Hits(
        jnp.where(is_nearer, scene.num_primitives + geom, hits.slot),
        jnp.where(is_nearer, raster.depth, hits.depth),
        hits.is_hit | is_nearer,
        jnp.where(is_nearer, raster.face, 0),
    )


def is_lit(
    scene: RenderScene,
    frames: Frames,
    hits: Hits,
    rays: tuple[Array, Array],
    light: Array,
    is_directional: bool,
) -> Array:
    """Returns f32[H, W]: 0 where a geom stands between the pixel's surface and the light, else 1.

    A geom is convex, so it never shades the part of itself that faces the light: its own row is passed over, and a
    surface needs no bias against itself. The light and what is seen lie outside of all other solids.

    Args:
      scene: shapes.
      frames: Frames.
      hits: Hits, with exact depths.
      rays: slopes of the pixels' rays, f32[1, W] and f32[H, 1].
      light: f32[3] in the camera's frame: m, where the light is, or for a directional light a unit vector towards it.
      is_directional: static.
    """
    x, y = rays
    point = (x * hits.depth, y * hits.depth, -hits.depth)
    # Rays run from the surface to a light at infinity, from any other light to the surface: what they share is computed
    # once for all pixels.
    if is_directional:
        start, way, low, high = point, _triple(light), scene.shadow_offset, jnp.full_like(hits.depth, jnp.inf)
    else:
        start, way = _triple(light), (point[0] - light[0], point[1] - light[1], point[2] - light[2])
        low, high = 0.0, 1.0 - scene.shadow_offset / jnp.sqrt(jnp.maximum(dot(way, way), 1e-12))

    def lit_past(kind: int, row: Array) -> Array:
        local_start = apply(frames.rotation[row], start, frames.origin[row])
        local_way = apply(frames.rotation[row], way)
        chord = CHORD_FUNCTIONS[kind](_triple(scene.size[row]), local_start, local_way)
        return jnp.where((chord > low) & (chord < high) & (hits.slot != row), 0.0, 1.0)

    is_kept = _between(frames, hits, rays, light, is_directional)
    return _minimum_over_geoms(scene, is_kept, lit_past, jnp.ones_like(hits.depth))


def _between(frames: Frames, hits: Hits, rays: tuple[Array, Array], light: Array, is_directional: bool) -> Array:
    """Returns bool[G]: the geom's bounding sphere reaches into the hull of all hit points and the light."""
    near = jnp.min(jnp.where(hits.is_hit, hits.depth, jnp.inf))
    far = jnp.max(jnp.where(hits.is_hit, hits.depth, -jnp.inf))
    near, far = jnp.where(near <= far, near, 1.0), jnp.where(near <= far, far, 1.0)
    # The hit points lie in a frustum from `near` to `far`; a sphere around a point of its axis holds it.
    middle = 0.5 * (near + far)
    x_middle, y_middle = (0.5 * (jnp.min(slopes) + jnp.max(slopes)) for slopes in rays)
    x_half, y_half = (0.5 * (jnp.max(slopes) - jnp.min(slopes)) for slopes in rays)
    sphere = middle * jnp.stack([x_middle, y_middle, -jnp.ones_like(middle)])
    axis_length = jnp.sqrt(1.0 + x_middle * x_middle + y_middle * y_middle)
    reach = frames.radius + (far - middle) * axis_length + far * jnp.sqrt(x_half * x_half + y_half * y_half)
    # The hull lies within that radius of the line from the sphere's middle to the light.
    way = light if is_directional else light - sphere
    offset = frames.center - sphere[None]
    along = jnp.maximum(offset @ way / jnp.maximum(way @ way, 1e-20), 0.0)
    along = along if is_directional else jnp.minimum(along, 1.0)
    gap = offset - along[:, None] * way[None]
    return jnp.sum(gap * gap, axis=-1) <= reach * reach
