"""Signed distances of points, segments and convex solids.

A vector is three arrays, one for each coordinate: XLA for CPU vectorises over pairs then, which it does not over
arrays whose last axis has three entries. Every function works on arrays of any one shape.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import Array

from vsearch_jax.xla.vectors import Vector, dot

GOLDEN = (math.sqrt(5.0) - 1.0) / 2.0
# 0.618^14 = 1e-3 of the axis; near its minimum the distance changes by far less. The ends are looked at too.
SEARCH_ITERATIONS = 14
# Tangents from both ends of the bracket: for axes as long as an arm's some 0.1 mm is left, on the safe side.
TANGENT_ITERATIONS = 6
# Newton's steps from the left of a convex sum converge quadratically, and what is left shortens the distance.
NEWTON_ITERATIONS = 6


def coordinates(vectors: Array) -> Vector:
    """Returns the coordinates of `vectors` (f32[..., 3])."""
    return vectors[..., 0], vectors[..., 1], vectors[..., 2]


def rotate(rotation: Array, vector: Vector) -> Vector:
    """Returns `vector` turned by `rotation` (f32[..., 3, 3])."""
    x, y, z = (dot(coordinates(rotation[..., row, :]), vector) for row in range(3))
    return x, y, z


def subtract(a: Vector, b: Vector) -> Vector:
    """Returns a - b."""
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


def add_scaled(a: Vector, s: Array, b: Vector) -> Vector:
    """Returns a + s b."""
    return a[0] + s * b[0], a[1] + s * b[1], a[2] + s * b[2]


def length(vector: Vector) -> Array:
    """Returns the length; its gradient is finite at zero."""
    return jnp.sqrt(jnp.maximum(dot(vector, vector), 1e-24))


def segment_distance(center_a: Vector, half_a: Vector, center_b: Vector, half_b: Vector) -> Array:
    """Returns the distance in m of two segments, each given by its middle and half of itself (m).

    A segment may be a point; parallel segments are no exception (Ericson, Real-Time Collision Detection, 5.1.9).
    """
    tiny = 1e-12
    offset = subtract(center_a, center_b)
    aa, bb, ab = dot(half_a, half_a), dot(half_b, half_b), dot(half_a, half_b)
    oa, ob = dot(half_a, offset), dot(half_b, offset)
    determinant = aa * bb - ab * ab
    is_skew = determinant > 1e-6 * aa * bb
    s = jnp.where(is_skew, (ab * ob - bb * oa) / jnp.where(is_skew, determinant, 1.0), 0.0)
    s = jnp.clip(s, -1.0, 1.0)
    t = jnp.clip((ab * s + ob) / jnp.maximum(bb, tiny), -1.0, 1.0)
    s = jnp.clip((ab * t - oa) / jnp.maximum(aa, tiny), -1.0, 1.0)
    t = jnp.clip((ab * s + ob) / jnp.maximum(bb, tiny), -1.0, 1.0)
    return length(add_scaled(add_scaled(offset, s, half_a), -t, half_b))


def segment_box_distance(center: Vector, half_axis: Vector, size: Vector) -> Array:
    """Returns the distance in m of a segment from a box, 0 where it passes through.

    The squared distance is convex along the segment and quadratic between the points where it crosses the planes of
    the faces. So its slope is a straight line between the last of them where it falls and the first where it rises.

    Args:
      center: m, the segment's middle in the box's frame.
      half_axis: m, from the middle to one end.
      size: m, half sizes of the box.
    """

    def outside(s: Array) -> Vector:
        x, y, z = (x - jnp.clip(x, -h, h) for x, h in zip(add_scaled(center, s, half_axis), size, strict=True))
        return x, y, z

    low, high = jnp.full_like(center[0], -1.0), jnp.ones_like(center[0])
    slope_first, slope_last = (dot(half_axis, outside(end)) for end in (low, high))
    slope_low, slope_high = jnp.minimum(slope_first, 0.0), jnp.maximum(slope_last, 0.0)
    for x, half, extent in zip(center, half_axis, size, strict=True):
        inverse = 1.0 / jnp.where(jnp.abs(half) < 1e-9, 1e-9, half)
        for face in (extent, -extent):
            s = jnp.clip((face - x) * inverse, -1.0, 1.0)
            slope = dot(half_axis, outside(s))
            falls, rises = slope <= 0.0, slope >= 0.0
            low, slope_low = _larger(low, s, falls), _larger(slope_low, slope, falls)
            high, slope_high = -_larger(-high, -s, rises), -_larger(-slope_high, -slope, rises)
    share = -slope_low / jnp.maximum(slope_high - slope_low, 1e-20)
    s = low + (high - low) * jnp.clip(share, 0.0, 1.0)
    s = jnp.where(slope_first >= 0.0, -1.0, jnp.where(slope_last <= 0.0, 1.0, s))
    return length(outside(s))


def _larger(a: Array, b: Array, is_taken: Array) -> Array:
    """Returns the larger of a and, where it is taken, b."""
    return jnp.where(is_taken, jnp.maximum(a, b), a)


def segment_cylinder_distance(center: Vector, half_axis: Vector, radius: Array, half_length: Array) -> Array:
    """Returns the distance in m of a segment from a cylinder about z, or a little less; 0 where it passes through.

    For segments of half a metre it is some 0.1 mm less at most. The distance is convex along the segment, so it lies
    above its tangents. Where those of the two ends of a bracket meet is the next place to look (Kelley: cutting
    planes, in one dimension).

    Args:
      center: m, the segment's middle in the cylinder's frame.
      half_axis: m, from the middle to one end.
      radius: m.
      half_length: m.
    """

    def at(s: Array) -> tuple[Array, Array, Array]:
        x, y, z = add_scaled(center, s, half_axis)
        radial = jnp.sqrt(jnp.maximum(x * x + y * y, 1e-24))
        beside, above = jnp.maximum(radial - radius, 0.0), z - jnp.clip(z, -half_length, half_length)
        distance = jnp.sqrt(jnp.maximum(beside * beside + above * above, 1e-24))
        outward = (x * half_axis[0] + y * half_axis[1]) / radial
        return s, distance, (beside * outward + above * half_axis[2]) / distance

    def meeting(low: tuple[Array, Array, Array], high: tuple[Array, Array, Array]) -> Array:
        (s_low, f_low, slope_low), (s_high, f_high, slope_high) = low, high
        s = f_high - f_low + slope_low * s_low - slope_high * s_high
        s = jnp.clip(s / jnp.minimum(slope_low - slope_high, -1e-9), s_low, s_high)
        return jnp.where(slope_low >= 0.0, s_low, jnp.where(slope_high <= 0.0, s_high, s))

    low, high = at(jnp.full_like(center[0], -1.0)), at(jnp.ones_like(center[0]))
    for _ in range(TANGENT_ITERATIONS):
        new = at(meeting(low, high))
        falls = new[2] <= 0.0
        low, high = (
            jax.tree.map(functools.partial(jnp.where, is_replaced), new, end)
            for is_replaced, end in ((falls, low), (~falls, high))
        )
    s = meeting(low, high)
    bounds = [distance + slope * (s - place) for place, distance, slope in (low, high)]
    return jnp.maximum(jnp.maximum(*bounds), 0.0)


def ellipsoid_distance(point: Vector, size: Vector) -> Array:
    """Returns the signed distance in m of `point` from an ellipsoid of radii `size`.

    The foot of the perpendicular is r^2 p / (t + r^2) with t the largest root of sum (r p / (t + r^2))^2 = 1 (Eberly,
    Distance from a Point to an Ellipsoid). The sum is convex and falls, so Newton's steps from the left stay left.
    """
    # The floor keeps the foot unique at the centre and in the planes of symmetry.
    p = tuple(jnp.maximum(jnp.abs(x), 1e-7) for x in point)
    squared = tuple(r * r for r in size)
    t = functools.reduce(jnp.maximum, [r * x - r * r for r, x in zip(size, p, strict=True)])
    for _ in range(NEWTON_ITERATIONS):
        ratios = [(r * x / (t + rr)) ** 2 for r, x, rr in zip(size, p, squared, strict=True)]
        slope = -2.0 * sum(ratio / (t + rr) for ratio, rr in zip(ratios, squared, strict=True))
        t = t - (sum(ratios) - 1.0) / slope
    x, y, z = (x - rr * x / (t + rr) for x, rr in zip(p, squared, strict=True))
    return jnp.sign(t) * length((x, y, z))


def least_along(distance: Callable[[Vector], Array], center: Vector, half_axis: Vector) -> Array:
    """Returns the least of a convex `distance` over the segments, by golden section."""

    def at(s: Array) -> Array:
        return distance(add_scaled(center, s, half_axis))

    if center[0].size == 0:
        return jnp.zeros_like(center[0])
    low = jnp.full(center[0].shape, -1.0)
    high = -low
    first = jnp.stack([high - GOLDEN * (high - low), low + GOLDEN * (high - low), low, high])
    f_low, f_high, *f_ends = jax.vmap(at)(first)  # four calls would be compiled one by one
    state = (low, high, f_low, f_high, jnp.minimum(*f_ends))
    *_, f_low, f_high, f_ends = jax.lax.fori_loop(0, SEARCH_ITERATIONS, functools.partial(_narrow, at), state)
    return jnp.minimum(jnp.minimum(f_low, f_high), f_ends)


def _narrow(at: Callable[[Array], Array], _: Array, state: tuple[Array, ...]) -> tuple[Array, ...]:
    low, high, f_low, f_high, f_ends = state  # f at low + (1 - GOLDEN) width and at low + GOLDEN width
    is_left = f_low < f_high
    width = high - low
    low, high = jnp.where(is_left, low, high - GOLDEN * width), jnp.where(is_left, low + GOLDEN * width, high)
    width = high - low
    f_new = at(jnp.where(is_left, high - GOLDEN * width, low + GOLDEN * width))
    return low, high, jnp.where(is_left, f_new, f_high), jnp.where(is_left, f_low, f_new), f_ends
