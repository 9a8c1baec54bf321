"""Ray–primitive intersection, one function for each MuJoCo geom type.

All functions have the signature `(size, point, direction) -> t`. Vectors are in the geom's own frame:

- `size`: three f32[] m, MuJoCo's `geom_size`.
- `point`: three f32[...] m, the origin of the ray.
- `direction`: three f32[...], the direction of the ray. It need not have length 1, but must not be 0.
- `t`: f32[...], the ray parameter. The intersection is at `point + t * direction`. On a miss, t is +inf.

There are two tables of such functions:

- `RAY_FUNCTIONS` return the smallest t >= 0, as C MuJoCo's `mj_ray` does. A ray that starts inside a solid hits the far
  wall. A plane is hit from its front only.
- `CHORD_FUNCTIONS` return t of some point that the infinite line shares with the solid. This t may be negative. They
  serve shadow rays: seen from an origin outside the convex solid, the whole chord lies ahead or the whole chord lies
  behind. So the sign of t tells whether the ray hits. For round solids this needs no square root.

All solids are convex. From outside, the ray hits where it enters; from inside, where it leaves. One comparison with the
origin decides which. XLA computes it once where all rays share their origin.

Vectors are tuples of three arrays, because XLA on CPU vectorises over pixels but not over a last axis of length 3.
Arguments of roots and divisors are bounded first, so values and gradients are finite at every hit.
"""

from __future__ import annotations

from collections.abc import Callable

import jax.numpy as jnp
from jax import Array
from mujoco import mjtGeom

from vsearch_jax.xla.vectors import Vector, dot

RayFunction = Callable[[Vector, Vector, Vector], Array]
"""`(size, point, direction) -> t`; see the module's docstring."""

# Far below any squared length of a scene in metres, and far above the smallest normal f32.
_TINY = 1e-20


def _safe_inverse(x: Array) -> Array:
    """Returns 1 / x, and 1e12 for x near 0."""
    return 1.0 / jnp.where(jnp.abs(x) < 1e-12, 1e-12, x)


def _quadratic_root(a: Array, b: Array, c: Array, sign: Array) -> tuple[Array, Array]:
    """Returns the smaller (`sign` -1) or larger (`sign` 1) root of a t^2 + 2 b t + c, and whether a root exists."""
    discriminant = b * b - a * c
    return (sign * jnp.sqrt(jnp.maximum(discriminant, _TINY)) - b) / a, discriminant > 0.0


def _root_sign(is_inside: Array) -> Array:
    """Returns the sign of the root to use: 1 (exit) for an origin inside the solid, -1 (entry) for one outside."""
    # A factor instead of a select: XLA does not vectorise a select whose predicate is one scalar for all pixels.
    return jnp.where(is_inside, 1.0, -1.0)


def _t_or_miss(t: Array, is_hit: Array) -> Array:
    """Returns `t`, or +inf where `is_hit` is false or `t` is negative."""
    return jnp.where(is_hit & (t >= 0.0), t, jnp.inf)


def _ray_plane(size: Vector, point: Vector, direction: Vector) -> Array:
    """Intersects the plane z = 0 from its front. A half side of 0 or less makes the plane infinite along that axis."""
    is_facing = direction[2] < -_TINY
    t = -point[2] / jnp.where(is_facing, direction[2], -1.0)
    x, y = point[0] + t * direction[0], point[1] + t * direction[1]
    limit_x, limit_y = (jnp.where(s <= 0.0, jnp.inf, s) for s in size[:2])
    return _t_or_miss(t, is_facing & (jnp.abs(x) <= limit_x) & (jnp.abs(y) <= limit_y))


def _ray_sphere(size: Vector, point: Vector, direction: Vector) -> Array:
    """Intersects the sphere of radius size[0]."""
    c = dot(point, point) - size[0] * size[0]
    return _t_or_miss(*_quadratic_root(dot(direction, direction), dot(direction, point), c, _root_sign(c < 0.0)))


def _ray_capsule(size: Vector, point: Vector, direction: Vector) -> Array:
    """Intersects the capsule of radius size[0] along z, where size[1] is half the distance of the caps' centres.

    First the ray is intersected with the infinite cylinder. If that hit lies between the caps' centres, it is the hit.
    If not, the ray is intersected with the sphere of the cap on that side.
    """
    radius, half_length, _ = size
    (px, py, pz), (vx, vy, vz) = point, direction
    squared_radial = px * px + py * py - radius * radius
    beyond = jnp.maximum(jnp.abs(pz) - half_length, 0.0)
    sign = _root_sign(squared_radial + beyond * beyond < 0.0)
    radial_length = vx * vx + vy * vy
    radial_product = vx * px + vy * py
    squared_length = radial_length + vz * vz
    # The added term keeps the divisor positive for a ray along the axis. Such a ray then meets the infinite cylinder
    # very far away, and so hits a cap.
    side, is_side = _quadratic_root(radial_length + 1e-12 * squared_length, radial_product, squared_radial, sign)
    z = pz + side * vz
    dz = pz - jnp.clip(z, -half_length, half_length)
    cap, is_cap = _quadratic_root(squared_length, radial_product + vz * dz, squared_radial + dz * dz, sign)
    is_on_side = jnp.abs(z) <= half_length
    return _t_or_miss(jnp.where(is_on_side, side, cap), is_side & (is_on_side | is_cap))


def _ray_ellipsoid(size: Vector, point: Vector, direction: Vector) -> Array:
    """Intersects the ellipsoid of semi-axes `size`."""
    inverse = [1.0 / s for s in size]  # scalars: one division for all pixels
    p = (point[0] * inverse[0], point[1] * inverse[1], point[2] * inverse[2])
    v = (direction[0] * inverse[0], direction[1] * inverse[1], direction[2] * inverse[2])
    c = dot(p, p) - 1.0
    return _t_or_miss(*_quadratic_root(dot(v, v), dot(v, p), c, _root_sign(c < 0.0)))


def _cylinder_interval(size: Vector, point: Vector, direction: Vector) -> tuple[Array, Array, Array]:
    """Returns whether the line meets the cylinder, and t where it enters and where it leaves."""
    radius, half_length, _ = size
    (px, py, pz), (vx, vy, vz) = point, direction
    radial_length = vx * vx + vy * vy
    a = radial_length + 1e-12 * (radial_length + vz * vz)  # positive for a ray along the axis, too
    b = vx * px + vy * py
    discriminant = b * b - a * (px * px + py * py - radius * radius)
    root, inverse_a = jnp.sqrt(jnp.maximum(discriminant, _TINY)), 1.0 / a
    inverse = _safe_inverse(vz)
    middle, half = -pz * inverse, half_length * jnp.abs(inverse)
    entry = jnp.maximum((-b - root) * inverse_a, middle - half)
    leave = jnp.minimum((-b + root) * inverse_a, middle + half)
    return (discriminant > 0.0) & (entry <= leave), entry, leave


def _ray_cylinder(size: Vector, point: Vector, direction: Vector) -> Array:
    """Intersects the cylinder of radius size[0] and half length size[1] along z."""
    is_met, entry, leave = _cylinder_interval(size, point, direction)
    return _t_or_miss(jnp.where(entry < 0.0, leave, entry), is_met)


def _box_interval(size: Vector, point: Vector, direction: Vector) -> tuple[Array, Array]:
    """Returns t where the line enters the box and where it leaves. The entry is the larger of them on a miss."""
    inverses = [_safe_inverse(v) for v in direction]
    middles = [-p * inverse for p, inverse in zip(point, inverses, strict=True)]
    halves = [s * jnp.abs(inverse) for s, inverse in zip(size, inverses, strict=True)]
    near = [middle - half for middle, half in zip(middles, halves, strict=True)]
    far = [middle + half for middle, half in zip(middles, halves, strict=True)]
    return jnp.maximum(jnp.maximum(near[0], near[1]), near[2]), jnp.minimum(jnp.minimum(far[0], far[1]), far[2])


def _ray_box(size: Vector, point: Vector, direction: Vector) -> Array:
    """Intersects the box of half sides `size`."""
    entry, leave = _box_interval(size, point, direction)
    return _t_or_miss(jnp.where(entry < 0.0, leave, entry), entry <= leave)


def _chord_plane(size: Vector, point: Vector, direction: Vector) -> Array:
    """Returns t where the line crosses the plane z = 0 from either side; `size` as for `_ray_plane`."""
    t = -point[2] * _safe_inverse(direction[2])
    x, y = point[0] + t * direction[0], point[1] + t * direction[1]
    limit_x, limit_y = (jnp.where(s <= 0.0, jnp.inf, s) for s in size[:2])
    return jnp.where((jnp.abs(x) <= limit_x) & (jnp.abs(y) <= limit_y), t, jnp.inf)


def _closest_inside_sphere(radius: Array, point: Vector, direction: Vector) -> Array:
    """Returns t of the line's point closest to the origin, or +inf where that point is outside the sphere."""
    squared_length = dot(direction, direction)
    product = dot(point, direction)
    # The squared distance of the line, less the squared radius, times squared_length.
    gap = squared_length * (dot(point, point) - radius * radius) - product * product
    return jnp.where(gap < 0.0, -product / squared_length, jnp.inf)


def _chord_sphere(size: Vector, point: Vector, direction: Vector) -> Array:
    """Returns t of the middle of the chord through the sphere of radius size[0]."""
    return _closest_inside_sphere(size[0], point, direction)


def _chord_capsule(size: Vector, point: Vector, direction: Vector) -> Array:
    """Returns t of the chord's point closest to a point of the capsule's axis."""
    (px, py, pz), (vx, vy, vz) = point, direction
    radial_length = vx * vx + vy * vy
    squared_length = radial_length + vz * vz
    # z of the axis point closest to the line. If the line is parallel to the axis, every axis point is equally close.
    z = (radial_length * pz - vz * (vx * px + vy * py)) / (radial_length + 1e-12 * squared_length)
    return _closest_inside_sphere(size[0], (px, py, pz - jnp.clip(z, -size[1], size[1])), direction)


def _chord_ellipsoid(size: Vector, point: Vector, direction: Vector) -> Array:
    """Returns t of the middle of the chord through the ellipsoid of semi-axes `size`."""
    inverse = [1.0 / s for s in size]
    p = (point[0] * inverse[0], point[1] * inverse[1], point[2] * inverse[2])
    v = (direction[0] * inverse[0], direction[1] * inverse[1], direction[2] * inverse[2])
    return _closest_inside_sphere(jnp.ones_like(inverse[0]), p, v)


def _chord_cylinder(size: Vector, point: Vector, direction: Vector) -> Array:
    """Returns t of the middle of the chord through the cylinder."""
    is_met, entry, leave = _cylinder_interval(size, point, direction)
    return jnp.where(is_met, 0.5 * (entry + leave), jnp.inf)


def _chord_box(size: Vector, point: Vector, direction: Vector) -> Array:
    """Returns t of the middle of the chord through the box."""
    entry, leave = _box_interval(size, point, direction)
    return jnp.where(entry <= leave, 0.5 * (entry + leave), jnp.inf)


RAY_FUNCTIONS: dict[int, RayFunction] = {
    int(mjtGeom.mjGEOM_PLANE): _ray_plane,
    int(mjtGeom.mjGEOM_SPHERE): _ray_sphere,
    int(mjtGeom.mjGEOM_CAPSULE): _ray_capsule,
    int(mjtGeom.mjGEOM_ELLIPSOID): _ray_ellipsoid,
    int(mjtGeom.mjGEOM_CYLINDER): _ray_cylinder,
    int(mjtGeom.mjGEOM_BOX): _ray_box,
}
"""By mjtGeom: the smallest t >= 0 of the ray, +inf on a miss."""

CHORD_FUNCTIONS: dict[int, RayFunction] = {
    int(mjtGeom.mjGEOM_PLANE): _chord_plane,
    int(mjtGeom.mjGEOM_SPHERE): _chord_sphere,
    int(mjtGeom.mjGEOM_CAPSULE): _chord_capsule,
    int(mjtGeom.mjGEOM_ELLIPSOID): _chord_ellipsoid,
    int(mjtGeom.mjGEOM_CYLINDER): _chord_cylinder,
    int(mjtGeom.mjGEOM_BOX): _chord_box,
}
"""By mjtGeom: t of a point that the infinite line shares with the solid, +inf on a miss."""
