"""The geoms as level sets: F(point) = 0 on the surface, and F's gradient points outwards."""

from __future__ import annotations

from collections.abc import Callable

import jax.numpy as jnp
from jax import Array
from mujoco import mjtGeom

from vsearch_jax.xla.vectors import Vector, dot

Level = tuple[Array, Vector]


def _plane(size: Vector, point: Vector) -> Level:
    zero = jnp.zeros_like(point[2])
    return point[2], (zero, zero, zero + 1.0)


def _sphere(size: Vector, point: Vector) -> Level:
    return 0.5 * (dot(point, point) - size[0] * size[0]), point


def _capsule(size: Vector, point: Vector) -> Level:
    x, y, z = point
    return _sphere(size, (x, y, z - jnp.clip(z, -size[1], size[1])))


def _ellipsoid(size: Vector, point: Vector) -> Level:
    # Pixels of other geoms pass through here too, with sizes that may be 0; their NaN would spoil the gradient.
    sx, sy, sz = (1.0 / jnp.maximum(s * s, 1e-12) for s in size)
    slope = (point[0] * sx, point[1] * sy, point[2] * sz)
    return 0.5 * (dot(slope, point) - 1.0), slope


def _cylinder(size: Vector, point: Vector) -> Level:
    x, y, z = point
    side = 0.5 * (x * x + y * y - size[0] * size[0])
    end = jnp.abs(z) - size[1]
    # Near the side, side / radius is the distance from it.
    is_side = side > end * size[0]
    slope = (jnp.where(is_side, x, 0.0), jnp.where(is_side, y, 0.0), jnp.where(is_side, 0.0, jnp.sign(z)))
    return jnp.where(is_side, side, end), slope


def _box(size: Vector, point: Vector) -> Level:
    x, y, z = (jnp.abs(p) - s for p, s in zip(point, size, strict=True))
    off = jnp.maximum(jnp.maximum(x, y), z)
    signs = (jnp.sign(p) for p in point)
    nx, ny, nz = (jnp.where(face >= off, sign, 0.0) for sign, face in zip(signs, (x, y, z), strict=True))
    return off, (nx, ny, nz)


LEVEL_FUNCTIONS: dict[int, Callable[[Vector, Vector], Level]] = {
    int(mjtGeom.mjGEOM_PLANE): _plane,
    int(mjtGeom.mjGEOM_SPHERE): _sphere,
    int(mjtGeom.mjGEOM_CAPSULE): _capsule,
    int(mjtGeom.mjGEOM_ELLIPSOID): _ellipsoid,
    int(mjtGeom.mjGEOM_CYLINDER): _cylinder,
    int(mjtGeom.mjGEOM_BOX): _box,
}


def level(slot: Array, starts: tuple[tuple[int, int], ...], size: Vector, point: Vector) -> Level:
    """Returns F of each pixel's own geom at a point on or near its surface, and F's gradient there.

    Args:
      slot: i32[H, W], row of each pixel's geom in the scene; rows are sorted by type.
      starts: for each type of the scene, in that order, mjtGeom and its first row.
      size: three f32[H, W] m, sizes of each pixel's geom.
      point: three f32[H, W] m, in the frame of that geom.

    Returns:
      f32[H, W], and three f32[H, W] in the geom's frame. On an edge the gradient is the sum of the faces' gradients.
    """
    zero = jnp.zeros_like(point[0])
    result: Level = (zero, (zero, zero, zero + 1.0))
    for kind, start in starts:
        other = LEVEL_FUNCTIONS[kind](size, point)
        result = other if start == 0 else select(slot >= start, other, result)
    return result


def select(condition: Array, a: Level, b: Level) -> Level:
    """Returns `a` where `condition`, elsewhere `b`."""
    x, y, z = (jnp.where(condition, i, j) for i, j in zip(a[1], b[1], strict=True))
    return jnp.where(condition, a[0], b[0]), (x, y, z)


def affine(rows: list[Array], point: Vector) -> list[Array]:
    """Returns the values at `point` of the affine maps whose coefficients are `rows`, four a value."""
    x, y, z = point
    return [a * x + b * y + c * z + d for a, b, c, d in zip(*(rows[i::4] for i in range(4)), strict=True)]
