"""Where a ray meets each primitive, on separate x, y, z planes.

Every function has the one signature `(size, point, direction) -> distance`, in the geom's own frame:

- `size`: three scalars, MuJoCo's `geom_size`;
- `point`, `direction`: the ray's origin and (not normalised) direction, each a triple of arrays that broadcast;
- `distance`: in units of `direction`'s length, the nearest at 0 or more, +inf on a miss, as C MuJoCo's `mj_ray` has it:
  a ray that starts inside a solid meets its far wall, a plane is met from its front only.

`ray_*` is that. `chord_*` has the same signature and returns some point that the whole line has in common with the
solid, of any sign, or +inf. Seen from outside, a convex solid lies wholly before or wholly behind, so the sign tells
which: that is all a shadow needs, and for round solids it is had without a root.

All solids are convex: from outside the entry counts, from inside the exit. Which of the two is one comparison of the
origin, and costs nothing where all rays share their origin. Triples instead of a last axis of 3 let XLA vectorise over
pixels; inputs of roots and divisions are made safe before, so values and gradients are finite wherever there is a hit.
"""

from __future__ import annotations

from collections.abc import Callable

import jax.numpy as jnp
from jax import Array
from mujoco import mjtGeom

from vsearch_jax.xla.vectors import Vector, dot

# Far below any squared length of a scene in metres, far above the smallest normal f32.
_TINY = 1e-20


def _safe_inverse(x: Array) -> Array:
    return 1.0 / jnp.where(jnp.abs(x) < 1e-12, 1e-12, x)


def _quadratic_root(a: Array, b: Array, c: Array, sign: Array) -> tuple[Array, Array]:
    """Returns the smaller (`sign` -1) or larger (1) root of a t^2 + 2 b t + c, and whether there is one."""
    discriminant = b * b - a * c
    return (sign * jnp.sqrt(jnp.maximum(discriminant, _TINY)) - b) / a, discriminant > 0.0


def _exit_sign(is_inside: Array) -> Array:
    """Returns which root counts; a factor, as a select by one predicate for all pixels is not vectorised."""
    return jnp.where(is_inside, 1.0, -1.0)


def _hit(distance: Array, is_hit: Array) -> Array:
    return jnp.where(is_hit & (distance >= 0.0), distance, jnp.inf)


def ray_plane(size: Vector, point: Vector, direction: Vector) -> Array:
    """Returns the distance to the front of the plane z = 0; a side with size 0 or less is endless."""
    is_facing = direction[2] < -_TINY
    distance = -point[2] / jnp.where(is_facing, direction[2], -1.0)
    x, y = point[0] + distance * direction[0], point[1] + distance * direction[1]
    limit_x, limit_y = (jnp.where(s <= 0.0, jnp.inf, s) for s in size[:2])
    return _hit(distance, is_facing & (jnp.abs(x) <= limit_x) & (jnp.abs(y) <= limit_y))


def ray_sphere(size: Vector, point: Vector, direction: Vector) -> Array:
    """Returns the distance to the sphere of radius size[0]."""
    c = dot(point, point) - size[0] * size[0]
    return _hit(*_quadratic_root(dot(direction, direction), dot(direction, point), c, _exit_sign(c < 0.0)))


def ray_capsule(size: Vector, point: Vector, direction: Vector) -> Array:
    """Returns the distance to the capsule of radius size[0] and half length size[1] along z, caps not counted.

    A line enters (leaves) the capsule through its side if it enters (leaves) the endless cylinder between the caps'
    centres, and otherwise through the cap on whose side of them it does.
    """
    radius, half_length, _ = size
    (px, py, pz), (vx, vy, vz) = point, direction
    squared_radial = px * px + py * py - radius * radius
    beyond = jnp.maximum(jnp.abs(pz) - half_length, 0.0)
    sign = _exit_sign(squared_radial + beyond * beyond < 0.0)
    radial_length = vx * vx + vy * vy
    radial_product = vx * px + vy * py
    squared_length = radial_length + vz * vz
    # A ray along the axis meets the endless cylinder very far out, hence at a cap.
    side, is_side = _quadratic_root(radial_length + 1e-12 * squared_length, radial_product, squared_radial, sign)
    z = pz + side * vz
    dz = pz - jnp.clip(z, -half_length, half_length)
    cap, is_cap = _quadratic_root(squared_length, radial_product + vz * dz, squared_radial + dz * dz, sign)
    is_on_side = jnp.abs(z) <= half_length
    return _hit(jnp.where(is_on_side, side, cap), is_side & (is_on_side | is_cap))


def ray_ellipsoid(size: Vector, point: Vector, direction: Vector) -> Array:
    """Returns the distance to the ellipsoid of half axes `size`."""
    inverse = [1.0 / s for s in size]  # once for all pixels
    p = (point[0] * inverse[0], point[1] * inverse[1], point[2] * inverse[2])
    v = (direction[0] * inverse[0], direction[1] * inverse[1], direction[2] * inverse[2])
    c = dot(p, p) - 1.0
    return _hit(*_quadratic_root(dot(v, v), dot(v, p), c, _exit_sign(c < 0.0)))


def _span_cylinder(size: Vector, point: Vector, direction: Vector) -> tuple[Array, Array, Array]:
    """Returns whether the line meets the cylinder, and where it enters and leaves."""
    radius, half_length, _ = size
    (px, py, pz), (vx, vy, vz) = point, direction
    radial_length = vx * vx + vy * vy
    a = radial_length + 1e-12 * (radial_length + vz * vz)
    b = vx * px + vy * py
    discriminant = b * b - a * (px * px + py * py - radius * radius)
    root, inverse_a = jnp.sqrt(jnp.maximum(discriminant, _TINY)), 1.0 / a
    inverse = _safe_inverse(vz)
    middle, half = -pz * inverse, half_length * jnp.abs(inverse)
    entry = jnp.maximum((-b - root) * inverse_a, middle - half)
    leave = jnp.minimum((-b + root) * inverse_a, middle + half)
    return (discriminant > 0.0) & (entry <= leave), entry, leave


def ray_cylinder(size: Vector, point: Vector, direction: Vector) -> Array:
    """Returns the distance to the cylinder of radius size[0] and half length size[1] along z."""
    is_met, entry, leave = _span_cylinder(size, point, direction)
    return _hit(jnp.where(entry < 0.0, leave, entry), is_met)


def _span_box(size: Vector, point: Vector, direction: Vector) -> tuple[Array, Array]:
    """Returns where the line enters and leaves the box; it enters after it leaves where it misses."""
    inverses = [_safe_inverse(v) for v in direction]
    middles = [-p * inverse for p, inverse in zip(point, inverses, strict=True)]
    halves = [s * jnp.abs(inverse) for s, inverse in zip(size, inverses, strict=True)]
    near = [middle - half for middle, half in zip(middles, halves, strict=True)]
    far = [middle + half for middle, half in zip(middles, halves, strict=True)]
    return jnp.maximum(jnp.maximum(near[0], near[1]), near[2]), jnp.minimum(jnp.minimum(far[0], far[1]), far[2])


def ray_box(size: Vector, point: Vector, direction: Vector) -> Array:
    """Returns the distance to the box of half sides `size`."""
    entry, leave = _span_box(size, point, direction)
    return _hit(jnp.where(entry < 0.0, leave, entry), entry <= leave)


def chord_plane(size: Vector, point: Vector, direction: Vector) -> Array:
    """Returns where the line crosses the plane z = 0, from either side; a side with size 0 or less is endless."""
    distance = -point[2] * _safe_inverse(direction[2])
    x, y = point[0] + distance * direction[0], point[1] + distance * direction[1]
    limit_x, limit_y = (jnp.where(s <= 0.0, jnp.inf, s) for s in size[:2])
    return jnp.where((jnp.abs(x) <= limit_x) & (jnp.abs(y) <= limit_y), distance, jnp.inf)


def _chord_round(radius: Array, point: Vector, direction: Vector) -> Array:
    """The middle of a sphere's chord, which is the line's point next to the centre."""
    squared_length = dot(direction, direction)
    product = dot(point, direction)
    gap = squared_length * (dot(point, point) - radius * radius) - product * product
    return jnp.where(gap < 0.0, -product / squared_length, jnp.inf)


def chord_sphere(size: Vector, point: Vector, direction: Vector) -> Array:
    """Returns the middle of the line's chord through the sphere of radius size[0]."""
    return _chord_round(size[0], point, direction)


def chord_capsule(size: Vector, point: Vector, direction: Vector) -> Array:
    """Returns a point of the line's chord through the capsule: the one next to the capsule's axis."""
    (px, py, pz), (vx, vy, vz) = point, direction
    radial_length = vx * vx + vy * vy
    squared_length = radial_length + vz * vz
    # The axis point next to the line, from d/dz of its squared distance; on a parallel line any point will do.
    z = (radial_length * pz - vz * (vx * px + vy * py)) / (radial_length + 1e-12 * squared_length)
    return _chord_round(size[0], (px, py, pz - jnp.clip(z, -size[1], size[1])), direction)


def chord_ellipsoid(size: Vector, point: Vector, direction: Vector) -> Array:
    """Returns the middle of the line's chord through the ellipsoid of half axes `size`."""
    inverse = [1.0 / s for s in size]
    p = (point[0] * inverse[0], point[1] * inverse[1], point[2] * inverse[2])
    v = (direction[0] * inverse[0], direction[1] * inverse[1], direction[2] * inverse[2])
    return _chord_round(jnp.ones_like(inverse[0]), p, v)


def chord_cylinder(size: Vector, point: Vector, direction: Vector) -> Array:
    """Returns the middle of the line's chord through the cylinder."""
    is_met, entry, leave = _span_cylinder(size, point, direction)
    return jnp.where(is_met, 0.5 * (entry + leave), jnp.inf)


def chord_box(size: Vector, point: Vector, direction: Vector) -> Array:
    """Returns the middle of the line's chord through the box."""
    entry, leave = _span_box(size, point, direction)
    return jnp.where(entry <= leave, 0.5 * (entry + leave), jnp.inf)


RayFunction = Callable[[Vector, Vector, Vector], Array]

RAY_FUNCTIONS: dict[int, RayFunction] = {
    int(mjtGeom.mjGEOM_PLANE): ray_plane,
    int(mjtGeom.mjGEOM_SPHERE): ray_sphere,
    int(mjtGeom.mjGEOM_CAPSULE): ray_capsule,
    int(mjtGeom.mjGEOM_ELLIPSOID): ray_ellipsoid,
    int(mjtGeom.mjGEOM_CYLINDER): ray_cylinder,
    int(mjtGeom.mjGEOM_BOX): ray_box,
}

CHORD_FUNCTIONS: dict[int, RayFunction] = {
    int(mjtGeom.mjGEOM_PLANE): chord_plane,
    int(mjtGeom.mjGEOM_SPHERE): chord_sphere,
    int(mjtGeom.mjGEOM_CAPSULE): chord_capsule,
    int(mjtGeom.mjGEOM_ELLIPSOID): chord_ellipsoid,
    int(mjtGeom.mjGEOM_CYLINDER): chord_cylinder,
    int(mjtGeom.mjGEOM_BOX): chord_box,
}
