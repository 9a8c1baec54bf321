"""Shadows that meshes and height fields cast: what the light sees of them, in a raster as fine as the image's.

A ray from every pixel to the light would look for faces in no order; the light's own view finds them as the camera's
does. It is cut to what both holds a face and is seen, so that its cells are about as large as the image's pixels are
there: shadows end where they should to about a pixel. A light that is not at infinity sees 80 degrees to each side of
the direction to the middle of the meshes; beyond, only primitives cast its shadows.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from vsearch_jax.render import trace
from vsearch_jax.render.geometry.rasterizer import Pinhole, View, rasterize
from vsearch_jax.render.scene import RenderScene
from vsearch_jax.xla.vectors import Vector, dot

# Cells of a map along an edge, for each pixel of the image's longer edge.
_CELLS_PER_PIXEL = 1.0
# Tangent of the widest angle that a light sees.
_WIDEST = 5.7
# The depth of a cell is compared at its middle, with that of the surface's own plane there. The plane is trusted no
# further than this many cells, and as much as the second number of cells is within the rounding of a curved surface.
_TRUST, _BIAS = 8.0, 0.3


class ShadowMap(NamedTuple):
    """How far each ray of a light goes before it meets a face.

    Attributes:
      depth: f32[S, S] m along the light's view, +inf where it meets none.
      rotation: f32[3, 3], camera's frame to the light's, which looks along -z.
      origin: f32[3] m, origin of the light's frame in the camera's.
      pinhole: how the light's view maps onto cells.
    """

    depth: Array
    rotation: Array
    origin: Array
    pinhole: Pinhole


def _frame(backward: Array) -> Array:
    """Returns f32[3, 3], a rotation whose last row is `backward`."""
    aside = jnp.where(jnp.abs(backward[0]) < 0.7, jnp.array([1.0, 0.0, 0.0]), jnp.array([0.0, 1.0, 0.0]))
    x = jnp.cross(aside, backward)
    x = x / jnp.sqrt(jnp.sum(x * x))
    return jnp.stack([x, jnp.cross(backward, x), backward])


def _bounds_of_casters(center: Array, radius: Array, is_directional: bool) -> tuple[Array, Array]:
    """Returns the least and the greatest x and y, f32[2] each, at which a geom's sphere may be in the light's view."""
    if is_directional:
        return jnp.min(center[:, :2] - radius[:, None], axis=0), jnp.max(center[:, :2] + radius[:, None], axis=0)
    depth = -center[:, 2:]
    middle = jnp.arctan2(center[:, :2], depth)
    distance = jnp.sqrt(center[:, :2] ** 2 + depth**2)
    # A light inside the sphere sees it all around.
    half = jnp.where(distance > radius[:, None], jnp.arcsin(jnp.clip(radius[:, None] / distance, 0.0, 1.0)), jnp.pi)
    widest = jnp.arctan(_WIDEST)
    low, high = jnp.min(middle - half, axis=0), jnp.max(middle + half, axis=0)
    return jnp.tan(jnp.clip(low, -widest, widest)), jnp.tan(jnp.clip(high, -widest, widest))


def _project(point: Vector, is_directional: bool) -> tuple[Array, Array, Array]:
    """Returns x and y in the light's view, and whether the light looks there."""
    depth = -point[2]
    if is_directional:
        return point[0], point[1], jnp.ones_like(depth, dtype=bool)
    is_before = depth > 1e-6
    inverse = 1.0 / jnp.where(is_before, depth, 1.0)
    x, y = point[0] * inverse, point[1] * inverse
    return x, y, is_before & (jnp.abs(x) < _WIDEST) & (jnp.abs(y) < _WIDEST)


def _pinhole(low: Array, high: Array, count: int) -> Pinhole:
    scale = count / jnp.maximum(high - low, 1e-6)
    return Pinhole(scale[0], scale[1], -0.5 - scale[0] * low[0], -0.5 + scale[1] * high[1])


def cast(
    scene: RenderScene,
    frames: trace.Frames,
    seen: tuple[Vector, Array],
    light: tuple[Array, bool],
    zero: Array,
) -> ShadowMap:
    """Returns what a light sees of meshes and height fields.

    Args:
      scene: RenderScene with triangles.
      frames: Frames.
      seen: three f32[...] m, what the camera sees, in its frame, and bool[...], where that is anything.
      light: f32[3] in the camera's frame: m, where the light is, or a unit vector towards it; and whether it is the
        latter.
      zero: see `boundary.materialize`.
    """
    triangles = scene.triangles
    assert triangles is not None
    (point, is_hit), (place, is_directional) = seen, light
    start = scene.num_primitives
    middle = jnp.mean(frames.center[start:], axis=0)
    toward = place if is_directional else place - middle
    rotation = _frame(toward / jnp.sqrt(jnp.maximum(toward @ toward, 1e-20)))
    origin = middle if is_directional else place
    x, y, is_seen = _project(trace.apply(rotation, point, -rotation @ origin), is_directional)
    is_seen &= is_hit
    low = jnp.stack([jnp.min(jnp.where(is_seen, axis, jnp.inf)) for axis in (x, y)])
    high = jnp.stack([jnp.max(jnp.where(is_seen, axis, -jnp.inf)) for axis in (x, y)])
    center = (frames.center[start:] - origin[None]) @ rotation.T
    caster_low, caster_high = _bounds_of_casters(center, triangles.radius, is_directional)
    pixel_count = is_hit.size
    cells = min(1024, int(_CELLS_PER_PIXEL * pixel_count**0.5))
    low, high = jnp.maximum(low, caster_low), jnp.minimum(high, caster_high)
    # Nothing in common: any window will do, as no pixel looks into it.
    low, high = jnp.where(low < high, low, caster_low), jnp.where(low < high, high, caster_high)
    pinhole = _pinhole(low, high, cells)
    pose = jnp.einsum("ij,gkj->gik", rotation, frames.rotation[start:])
    pose = jnp.concatenate([pose, center[:, :, None]], axis=2).reshape(-1, 12).T
    is_culled = triangles.is_closed
    if not is_directional:
        local = frames.rotation[start:] @ place + frames.origin[start:]
        is_outside = jnp.any((local < triangles.low) | (local > triangles.high), axis=1)
        is_culled = jnp.where(is_outside, is_culled, 0.0)
    raster = rasterize(triangles, View(pose, is_culled, pinhole, is_directional), (cells, cells), zero)
    return ShadowMap(raster.depth, rotation, origin, pinhole)


def is_lit(shadow: ShadowMap, point: Vector, normal: Vector, is_directional: bool, offset: Array) -> Array:
    """Returns f32[H, W]: 0 where a face stands between the point and the light, else 1.

    Args:
      shadow: ShadowMap.
      point: three f32[H, W] m, in the camera's frame.
      normal: three f32[H, W], of the surface there, smooth or not, of length 1.
      is_directional: static.
      offset: f32[] m, depths closer than this are the same.
    """
    local = trace.apply(shadow.rotation, point, -shadow.rotation @ shadow.origin)
    slope = trace.apply(shadow.rotation, normal)
    x, y, is_seen = _project(local, is_directional)
    pinhole, cells = shadow.pinhole, shadow.depth.shape[0]
    column = jnp.round(pinhole.center_x + pinhole.scale_x * x)
    row = jnp.round(pinhole.center_y - pinhole.scale_y * y)
    is_inside = is_seen & (column >= 0) & (column < cells) & (row >= 0) & (row < cells)
    index = jnp.where(is_inside, row * cells + column, 0.0).astype(jnp.int32)
    met = shadow.depth.reshape(-1).at[index].get(mode="promise_in_bounds")
    cell_x, cell_y = (column - pinhole.center_x) / pinhole.scale_x, (pinhole.center_y - row) / pinhole.scale_y
    depth, unit = -local[2], jnp.maximum(1.0 / pinhole.scale_x, 1.0 / pinhole.scale_y)
    if is_directional:
        steep = jnp.where(jnp.abs(slope[2]) < 1e-3, 1e-3, slope[2])
        there = depth + (slope[0] * (cell_x - x) + slope[1] * (cell_y - y)) / steep
    else:
        steep = slope[0] * cell_x + slope[1] * cell_y - slope[2]
        there = dot(slope, local) / jnp.where(jnp.abs(steep) < 1e-3, 1e-3, steep)
        unit = unit * depth
    there = jnp.clip(there, depth - _TRUST * unit, depth + _TRUST * unit)
    return jnp.where(is_inside & (met < there - _BIAS * unit - offset), 0.0, 1.0)
