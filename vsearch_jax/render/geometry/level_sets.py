"""Level-set functions of the primitives, one for each MuJoCo geom type.

A level-set function F is 0 on the geom's surface, and its gradient points outwards. The renderer uses F for a Newton
step that refines a hit's depth, and the gradient as the surface normal. F need not be the distance to the surface.

All functions have the signature `(size, point) -> (F, gradient of F)`, with `size` and `point` in the geom's own frame,
in m.
"""

from __future__ import annotations

from collections.abc import Callable

import jax.numpy as jnp
from jax import Array
from mujoco import mjtGeom

from vsearch_jax.xla.vectors import Vector, dot

ValueAndGradient = tuple[Array, Vector]


def _plane(size: Vector, point: Vector) -> ValueAndGradient:
    zero = jnp.zeros_like(point[2])
    return point[2], (zero, zero, zero + 1.0)


def _sphere(size: Vector, point: Vector) -> ValueAndGradient:
    return 0.5 * (dot(point, point) - size[0] * size[0]), point


def _capsule(size: Vector, point: Vector) -> ValueAndGradient:
    x, y, z = point
    return _sphere(size, (x, y, z - jnp.clip(z, -size[1], size[1])))


def _ellipsoid(size: Vector, point: Vector) -> ValueAndGradient:
    # Every pixel runs through every function, also with the size of another geom, which may hold zeros. The bound
    # prevents a NaN, which would spoil the gradient even where the result is not selected.
    sx, sy, sz = (1.0 / jnp.maximum(s * s, 1e-12) for s in size)
    slope = (point[0] * sx, point[1] * sy, point[2] * sz)
    return 0.5 * (dot(slope, point) - 1.0), slope


def _cylinder(size: Vector, point: Vector) -> ValueAndGradient:
    x, y, z = point
    side = 0.5 * (x * x + y * y - size[0] * size[0])
    end = jnp.abs(z) - size[1]
    # Near the side surface, side / radius is the distance from it.
    is_side = side > end * size[0]
    slope = (jnp.where(is_side, x, 0.0), jnp.where(is_side, y, 0.0), jnp.where(is_side, 0.0, jnp.sign(z)))
    return jnp.where(is_side, side, end), slope


def _box(size: Vector, point: Vector) -> ValueAndGradient:
    x, y, z = (jnp.abs(p) - s for p, s in zip(point, size, strict=True))
    largest = jnp.maximum(jnp.maximum(x, y), z)
    signs = (jnp.sign(p) for p in point)
    nx, ny, nz = (jnp.where(face >= largest, sign, 0.0) for sign, face in zip(signs, (x, y, z), strict=True))
    return largest, (nx, ny, nz)


_LEVEL_FUNCTIONS: dict[int, Callable[[Vector, Vector], ValueAndGradient]] = {
    int(mjtGeom.mjGEOM_PLANE): _plane,
    int(mjtGeom.mjGEOM_SPHERE): _sphere,
    int(mjtGeom.mjGEOM_CAPSULE): _capsule,
    int(mjtGeom.mjGEOM_ELLIPSOID): _ellipsoid,
    int(mjtGeom.mjGEOM_CYLINDER): _cylinder,
    int(mjtGeom.mjGEOM_BOX): _box,
}


def level(slot: Array, starts: tuple[tuple[int, int], ...], size: Vector, point: Vector) -> ValueAndGradient:
    """Evaluates for each pixel the level-set function F of the geom that the pixel shows, and the gradient of F.

    F is 0 on the surface of the geom. The gradient of F is an outward normal. The image has H x W pixels.

    Args:
      slot: i32[H, W], row of each pixel's geom in the scene. Rows are sorted by geom type.
      starts: (mjtGeom, first row) of each geom type in the scene, sorted by row; from `render.trace.type_starts`.
      size: three f32[H, W] m, MuJoCo's `geom_size` of each pixel's geom.
      point: three f32[H, W] m, a point on or near the surface of each pixel's geom, in the frame of that geom.

    Returns:
      F, f32[H, W], and the gradient of F, three f32[H, W], in the geom's frame. On an edge of a box the gradient is the
      sum of the faces' gradients. In a scene without primitives, F is 0 and the gradient is (0, 0, 1).
    """
    zero = jnp.zeros_like(point[0])
    result: ValueAndGradient = (zero, (zero, zero, zero + 1.0))
    for kind, start in starts:
        of_kind = _LEVEL_FUNCTIONS[kind](size, point)
        result = of_kind if start == 0 else select(slot >= start, of_kind, result)
    return result


def select(condition: Array, a: ValueAndGradient, b: ValueAndGradient) -> ValueAndGradient:
    """Returns `a` where `condition` is true, else `b`. Both hold a value and a gradient for each of H x W pixels.

    Args:
      condition: bool[H, W].
      a: value f32[H, W], and gradient as three f32[H, W].
      b: value f32[H, W], and gradient as three f32[H, W].
    """
    x, y, z = (jnp.where(condition, i, j) for i, j in zip(a[1], b[1], strict=True))
    return jnp.where(condition, a[0], b[0]), (x, y, z)


def affine(rows: list[Array], point: Vector) -> list[Array]:
    """Evaluates N affine functions a x + b y + c z + d at one point (x, y, z) for each of H x W pixels.

    Args:
      rows: 4 N arrays f32[H, W]: a, b, c, d of the first function, then of the second, and so on.
      point: x, y and z of each pixel's point, three f32[H, W].

    Returns:
      Values of the N functions, N arrays f32[H, W].
    """
    x, y, z = point
    return [a * x + b * y + c * z + d for a, b, c, d in zip(*(rows[i::4] for i in range(4)), strict=True)]
