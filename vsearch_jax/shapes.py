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

Vector = tuple[Array, Array, Array]

GOLDEN = (math.sqrt(5.0) - 1.0) / 2.0
# 0.618^14 = 1e-3 of the axis; near its minimum the distance changes by far less. The ends are looked at too.
SEARCH_ITERATIONS = 14
# Newton's steps from the left of a convex sum converge quadratically, and what is left shortens the distance.
NEWTON_ITERATIONS = 4


def planes(vectors: Array) -> Vector:
    """Returns the coordinates of `vectors` (f32[..., 3])."""
    return vectors[..., 0], vectors[..., 1], vectors[..., 2]


def dot(a: Vector, b: Vector) -> Array:
    """Returns the inner product."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def turned(rotation: Array, vector: Vector) -> Vector:
    """Returns `vector` turned by `rotation` (f32[..., 3, 3])."""
    x, y, z = (dot(planes(rotation[..., row, :]), vector) for row in range(3))
    return x, y, z


def turned_back(rotation: Array, vector: Vector) -> Vector:
    """Returns `vector` turned by the inverse of `rotation` (f32[..., 3, 3])."""
    x, y, z = (dot(planes(rotation[..., :, column]), vector) for column in range(3))
    return x, y, z


def minus(a: Vector, b: Vector) -> Vector:
    """Returns a - b."""
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


def along(a: Vector, s: Array, b: Vector) -> Vector:
    """Returns a + s b."""
    return a[0] + s * b[0], a[1] + s * b[1], a[2] + s * b[2]


def norm(vector: Vector) -> Array:
    """Returns the length; its gradient is finite at zero."""
    return jnp.sqrt(jnp.maximum(dot(vector, vector), 1e-24))


def segment_distance(center_a: Vector, half_a: Vector, center_b: Vector, half_b: Vector) -> Array:
    """Returns the distance in m of two segments, each given by its middle and half of itself (m).

    A segment may be a point; parallel segments are no exception (Ericson, Real-Time Collision Detection, 5.1.9).
    """
    tiny = 1e-12
    offset = minus(center_a, center_b)
    aa, bb, ab = dot(half_a, half_a), dot(half_b, half_b), dot(half_a, half_b)
    oa, ob = dot(half_a, offset), dot(half_b, offset)
    determinant = aa * bb - ab * ab
    is_skew = determinant > 1e-6 * aa * bb
    s = jnp.where(is_skew, (ab * ob - bb * oa) / jnp.where(is_skew, determinant, 1.0), 0.0)
    s = jnp.clip(s, -1.0, 1.0)
    t = jnp.clip((ab * s + ob) / jnp.maximum(bb, tiny), -1.0, 1.0)
    s = jnp.clip((ab * t - oa) / jnp.maximum(aa, tiny), -1.0, 1.0)
    t = jnp.clip((ab * s + ob) / jnp.maximum(bb, tiny), -1.0, 1.0)
    return norm(along(along(offset, s, half_a), -t, half_b))


def block_distance(point: Vector, size: Vector, is_cylinder: Array) -> Array:
    """Returns the signed distance in m of a point from a box or a cylinder.

    Args:
      point: m, in the solid's frame.
      size: m: half sizes of a box; radius and half length of a cylinder about z.
      is_cylinder: bool.
    """
    x, y, z = point
    # A cylinder is a rectangle in the half plane of the point; its third face is too deep to matter.
    radial = jnp.sqrt(jnp.maximum(x * x + y * y, 1e-24))
    first = jnp.where(is_cylinder, radial, jnp.abs(x)) - size[0]
    second = jnp.where(is_cylinder, jnp.abs(z), jnp.abs(y)) - size[1]
    third = jnp.where(is_cylinder, -jnp.inf, jnp.abs(z) - size[2])
    outside = norm((jnp.maximum(first, 0.0), jnp.maximum(second, 0.0), jnp.maximum(third, 0.0)))
    return outside + jnp.minimum(jnp.maximum(jnp.maximum(first, second), third), 0.0)


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
    return jnp.sign(t) * norm((x, y, z))


def least_along(distance: Callable[[Vector], Array], center: Vector, half_axis: Vector) -> Array:
    """Returns the least of a convex `distance` over the segments, by golden section."""

    def at(s: Array) -> Array:
        return distance(along(center, s, half_axis))

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
