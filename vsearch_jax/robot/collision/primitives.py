"""Distances of points and segments from segments, boxes, cylinders and ellipsoids.

A vector is a tuple of three arrays (`xla.vectors.Vector`), so that XLA on CPU vectorises over the pairs. All functions
are elementwise: the coordinate arrays have any one shape, written f32[...] here.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from typing import NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
from jax import Array

from vsearch_jax.xla.vectors import Vector, dot

GOLDEN = (math.sqrt(5.0) - 1.0) / 2.0
# Golden section leaves 0.618^14 = 1e-3 of the axis. The distance changes far less than that near its minimum.
SEARCH_ITERATIONS = 14
# Cutting planes leave an error of about 0.1 mm for the axes of a robot arm. The result is then too small, never too
# large.
TANGENT_ITERATIONS = 6
# Newton's method converges from the left, so the remaining error makes the distance smaller. It is below 1e-6 m for
# points outside of ellipsoids with radii of 1 to 30 cm.
NEWTON_ITERATIONS = 6


def coordinates(vectors: Array) -> Vector:
    """Splits vectors f32[..., 3] into a Vector, the tuple of their x, y and z coordinates (f32[...] each)."""
    return vectors[..., 0], vectors[..., 1], vectors[..., 2]


def rotate(rotation: Array, vector: Vector) -> Vector:
    """Rotates vectors that are stored by coordinate (Vector: the tuple of the arrays x, y and z).

    Args:
      rotation: f32[..., 3, 3], rotation matrices.
      vector: Vector of f32[...], the vectors.

    Returns:
      The rotated vectors, Vector of f32[...]: `rotation` times `vector`.
    """
    x, y, z = (dot(coordinates(rotation[..., row, :]), vector) for row in range(3))
    return x, y, z


def subtract(a: Vector, b: Vector) -> Vector:
    """Returns a - b for vectors that are stored by coordinate (Vector: the tuple of the arrays x, y and z).

    Args:
      a: Vector of f32[...].
      b: Vector of f32[...].
    """
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


def add_scaled(a: Vector, s: Array, b: Vector) -> Vector:
    """Returns a + s b for vectors that are stored by coordinate (Vector: the tuple of the arrays x, y and z).

    Args:
      a: Vector of f32[...].
      s: f32[...], factor of `b`.
      b: Vector of f32[...].
    """
    return a[0] + s * b[0], a[1] + s * b[1], a[2] + s * b[2]


def length(vector: Vector) -> Array:
    """Returns the Euclidean length f32[...] of a Vector (x, y and z, f32[...] each).

    At zero the length is 1e-12, and its gradient is finite.
    """
    return jnp.sqrt(jnp.maximum(dot(vector, vector), 1e-24))


def segment_distance(center_a: Vector, half_a: Vector, center_b: Vector, half_b: Vector) -> Array:
    """Returns the distance f32[...] in m between two segments (Ericson, Real-Time Collision Detection, 5.1.9).

    A segment may be a point. Segments may be parallel. Each Vector is a tuple of x, y and z, f32[...] each.

    Args:
      center_a: Vector in m, midpoint of the first segment.
      half_a: Vector in m, from the midpoint of the first segment to one of its ends.
      center_b: Vector in m, midpoint of the second segment.
      half_b: Vector in m, from the midpoint of the second segment to one of its ends.
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
    """Returns the distance f32[...] in m of a segment from a box; about 0 where the segment intersects the box.

    The squared distance is convex along the segment. It is quadratic between the points where the segment crosses the
    planes of the faces. Its slope is therefore linear between two neighbouring points. The minimum is where
    the slope is 0, between the last point with a negative slope and the first point with a positive slope.

    Args:
      center: Vector (x, y and z) in m, midpoint of the segment in the box's frame.
      half_axis: Vector in m, from the midpoint to one end of the segment, in the box's frame.
      size: Vector in m, half sizes of the box.
    """

    def offset_from_box(s: Array) -> Vector:
        """Returns the vector from the box's nearest point to the segment's point at `s`."""
        point = add_scaled(center, s, half_axis)
        x, y, z = (x - jnp.clip(x, -h, h) for x, h in zip(point, size, strict=True))
        return x, y, z

    low, high = jnp.full_like(center[0], -1.0), jnp.ones_like(center[0])
    slope_first, slope_last = (dot(half_axis, offset_from_box(end)) for end in (low, high))
    slope_low, slope_high = jnp.minimum(slope_first, 0.0), jnp.maximum(slope_last, 0.0)
    for x, half, extent in zip(center, half_axis, size, strict=True):
        inverse = 1.0 / jnp.where(jnp.abs(half) < 1e-9, 1e-9, half)
        for face in (extent, -extent):
            s = jnp.clip((face - x) * inverse, -1.0, 1.0)
            slope = dot(half_axis, offset_from_box(s))
            is_falling, is_rising = slope <= 0.0, slope >= 0.0
            low, slope_low = _maximum_where(is_falling, low, s), _maximum_where(is_falling, slope_low, slope)
            high = -_maximum_where(is_rising, -high, -s)
            slope_high = -_maximum_where(is_rising, -slope_high, -slope)
    share = -slope_low / jnp.maximum(slope_high - slope_low, 1e-20)
    s = low + (high - low) * jnp.clip(share, 0.0, 1.0)
    s = jnp.where(slope_first >= 0.0, -1.0, jnp.where(slope_last <= 0.0, 1.0, s))
    return length(offset_from_box(s))


def _maximum_where(condition: Array, a: Array, b: Array) -> Array:
    """Returns the maximum of `a` and `b` where `condition` is true, elsewhere `a`."""
    return jnp.where(condition, jnp.maximum(a, b), a)


class _Tangent(NamedTuple):
    """The tangent of a distance function at one point of a segment.

    Attributes:
      s: f32[...] in [-1, 1], the point; -1 and 1 are the ends of the segment.
      distance: f32[...] m, distance at `s`.
      slope: f32[...] m, derivative of the distance with respect to `s`.
    """

    s: Array
    distance: Array
    slope: Array


def segment_cylinder_distance(center: Vector, half_axis: Vector, radius: Array, half_length: Array) -> Array:
    """Returns a lower bound f32[...] in m of the distance of a segment from a cylinder about z.

    For segments of 0.5 m the bound is at most about 0.1 mm below the distance. It is about 0 where the segment
    intersects the cylinder. The method is Kelley's cutting planes in one dimension: the distance is convex along the
    segment, so it lies above its tangents. The next point of a bracket is where the tangents of its two ends intersect.

    Args:
      center: Vector (x, y and z) in m, midpoint of the segment in the cylinder's frame.
      half_axis: Vector in m, from the midpoint to one end of the segment, in the cylinder's frame.
      radius: f32[...] m, radius of the cylinder.
      half_length: f32[...] m, half the length of the cylinder.
    """

    def tangent(s: Array) -> _Tangent:
        x, y, z = add_scaled(center, s, half_axis)
        radial = jnp.sqrt(jnp.maximum(x * x + y * y, 1e-24))
        radial_gap, axial_gap = jnp.maximum(radial - radius, 0.0), z - jnp.clip(z, -half_length, half_length)
        distance = jnp.sqrt(jnp.maximum(radial_gap * radial_gap + axial_gap * axial_gap, 1e-24))
        radial_slope = (x * half_axis[0] + y * half_axis[1]) / radial
        return _Tangent(s, distance, (radial_gap * radial_slope + axial_gap * half_axis[2]) / distance)

    low, high = tangent(jnp.full_like(center[0], -1.0)), tangent(jnp.ones_like(center[0]))
    for _ in range(TANGENT_ITERATIONS):
        new = tangent(_tangent_intersection(low, high))
        is_falling = new.slope <= 0.0
        low, high = (
            jax.tree.map(functools.partial(jnp.where, is_replaced), new, end)
            for is_replaced, end in ((is_falling, low), (~is_falling, high))
        )
    s = _tangent_intersection(low, high)
    bounds = [end.distance + end.slope * (s - end.s) for end in (low, high)]
    return jnp.maximum(jnp.maximum(*bounds), 0.0)


def _tangent_intersection(low: _Tangent, high: _Tangent) -> Array:
    """Returns f32[...], where two tangents of a convex function intersect; an end if the minimum lies there."""
    s = high.distance - low.distance + low.slope * low.s - high.slope * high.s
    s = jnp.clip(s / jnp.minimum(low.slope - high.slope, -1e-9), low.s, high.s)
    return jnp.where(low.slope >= 0.0, low.s, jnp.where(high.slope <= 0.0, high.s, s))


def ellipsoid_distance(point: Vector, size: Vector) -> Array:
    """Returns the signed distance f32[...] in m of a point from an ellipsoid's surface; negative inside.

    The nearest point of the surface is r^2 p / (t + r^2), for each coordinate p and radius r. Here t is the largest
    root of S = sum (r p / (t + r^2))^2 = 1 (Eberly, Distance from a Point to an Ellipsoid). 1 / sqrt(S) is concave and
    nearly linear in t (More and Sorensen 1983, Computing a Trust Region Step). So Newton's method for 1 / sqrt(S) = 1
    converges fast from the left, and never passes the root.

    Args:
      point: Vector (x, y and z) in m, in the ellipsoid's frame.
      size: Vector in m, radii of the ellipsoid.
    """
    # The floor makes the nearest point unique at the centre and in the planes of symmetry.
    p = tuple(jnp.maximum(jnp.abs(x), 1e-7) for x in point)
    squared = tuple(r * r for r in size)
    # Lower bounds of the root: one coordinate alone, all with the largest radius below, and 0 for a point outside.
    scaled = (size[0] * p[0], size[1] * p[1], size[2] * p[2])
    bounds = [x - rr for x, rr in zip(scaled, squared, strict=True)]
    t = functools.reduce(jnp.maximum, [*bounds, length(scaled) - functools.reduce(jnp.maximum, squared)])
    is_outside = sum((x / r) ** 2 for x, r in zip(p, size, strict=True)) > 1.0
    t = jnp.where(is_outside, jnp.maximum(t, 0.0), t)
    for _ in range(NEWTON_ITERATIONS):
        ratios = [(x / (t + rr)) ** 2 for x, rr in zip(scaled, squared, strict=True)]
        total = functools.reduce(jnp.add, ratios)
        slope = functools.reduce(jnp.add, [ratio / (t + rr) for ratio, rr in zip(ratios, squared, strict=True)])
        t = t + total * (jnp.sqrt(total) - 1.0) / slope
    x, y, z = (x - rr * x / (t + rr) for x, rr in zip(p, squared, strict=True))
    return jnp.sign(t) * length((x, y, z))


def min_along_segment(distance: Callable[[Vector], Array], center: Vector, half_axis: Vector) -> Array:
    """Returns the minimum f32[...] in m of a convex function along a segment, by golden-section search.

    Args:
      distance: the function. It maps points (Vector: x, y and z, f32[...] each) to f32[...] m. It must be convex along
        each segment.
      center: Vector in m, midpoint of the segment.
      half_axis: Vector in m, from the midpoint to one end of the segment.
    """

    def distance_at(s: Array) -> Array:
        return distance(add_scaled(center, s, half_axis))

    if center[0].size == 0:
        return jnp.zeros_like(center[0])
    low = jnp.full(center[0].shape, -1.0)
    high = -low
    first = jnp.stack([high - GOLDEN * (high - low), low + GOLDEN * (high - low), low, high])
    f_low, f_high, *f_ends = jax.vmap(distance_at)(first)  # XLA would compile four separate calls one by one.
    bracket = (low, high, f_low, f_high, jnp.minimum(*f_ends))
    narrow = functools.partial(_narrow_bracket, distance_at)
    *_, f_low, f_high, f_ends = jax.lax.fori_loop(0, SEARCH_ITERATIONS, narrow, bracket)
    return jnp.minimum(jnp.minimum(f_low, f_high), f_ends)


_Bracket: TypeAlias = tuple[Array, Array, Array, Array, Array]
"""Ends of the bracket; values at low + (1 - GOLDEN) width and low + GOLDEN width; minimum at the segment's ends."""


def _narrow_bracket(distance_at: Callable[[Array], Array], _: Array, bracket: _Bracket) -> _Bracket:
    """Makes one step of golden-section search."""
    low, high, f_low, f_high, f_ends = bracket
    is_left = f_low < f_high
    width = high - low
    low, high = jnp.where(is_left, low, high - GOLDEN * width), jnp.where(is_left, low + GOLDEN * width, high)
    width = high - low
    f_new = distance_at(jnp.where(is_left, high - GOLDEN * width, low + GOLDEN * width))
    return low, high, jnp.where(is_left, f_new, f_high), jnp.where(is_left, f_low, f_new), f_ends
