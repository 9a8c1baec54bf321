"""Angles, camera poses on the view sphere, rotation errors and code similarity.

Every function is finite, with finite gradients, at its degenerate points.
"""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array
from jaxlie import SE3, SO3

from vsearch_jax.types import View


def wrap_angle(angle: Array) -> Array:
    """Adds a multiple of 2 pi to each angle, so that it lies in [-pi, pi).

    Args:
      angle: f32[...] rad.

    Returns:
      The wrapped angles, f32[...] rad.
    """
    return jnp.mod(angle + jnp.pi, 2.0 * jnp.pi) - jnp.pi


def angle_difference(a: Array, b: Array) -> Array:
    """Returns the shortest rotation from angle `b` to angle `a`, with its sign, in rad, in [-pi, pi).

    Args:
      a: f32[...] rad, final angles.
      b: f32[...] rad, initial angles.
    """
    return wrap_angle(a - b)


def fold_into_band(elevation: Array, band: Array) -> Array:
    """Moves elevations into the band of a search by reflection at the ends of the band.

    Reflection keeps the density of random samples smooth. Clipping would put many samples on the ends of the band.

    Args:
      elevation: f32[...] rad, elevations inside or outside the band.
      band: f32[2] rad, lowest and highest elevation. A band of zero width gives its one elevation.

    Returns:
      Elevations inside the band, f32[...] rad.
    """
    width = band[1] - band[0]
    period = jnp.where(width > 0.0, 2.0 * width, 1.0)
    offset = jnp.mod(elevation - band[0], period)
    folded = band[0] + jnp.minimum(offset, period - offset)
    return jnp.where(width > 0.0, jnp.clip(folded, band[0], band[1]), band[0])


def view_from_uniform(numbers: Array, band: Array) -> View:
    """Converts numbers that are uniform in [0, 1] to views that are uniform in azimuth and in the band of elevations.

    Args:
      numbers: f32[2, ...] in [0, 1], for azimuth and elevation.
      band: f32[2] rad, lowest and highest elevation.

    Returns:
      View of f32[...] rad.
    """
    return View(jnp.pi * (2.0 * numbers[0] - 1.0), band[0] + (band[1] - band[0]) * numbers[1])


def view_pose(view: View, center: Array, radius: float | Array) -> SE3:
    """Returns the camera's pose in world (T_world_camera) for a view: the camera looks at `center`, image upright.

    The camera's x axis is horizontal and points in the direction of growing azimuth. So the pose is defined at the pole
    too: it is the limit along the meridian of the azimuth.

    Args:
      view: azimuth and elevation of the camera on the view sphere, f32[] rad each.
      center: f32[3] m, centre of the view sphere in world.
      radius: f32[] m, radius of the view sphere.
    """
    cos_azimuth, sin_azimuth = jnp.cos(view.azimuth), jnp.sin(view.azimuth)
    cos_elevation, sin_elevation = jnp.cos(view.elevation), jnp.sin(view.elevation)
    zero = jnp.zeros_like(cos_azimuth)
    right = jnp.stack([-sin_azimuth, cos_azimuth, zero], axis=-1)
    up = jnp.stack([-sin_elevation * cos_azimuth, -sin_elevation * sin_azimuth, cos_elevation], axis=-1)
    backward = jnp.stack([cos_elevation * cos_azimuth, cos_elevation * sin_azimuth, sin_elevation], axis=-1)
    rotation = SO3.from_matrix(jnp.stack([right, up, backward], axis=-1))
    return SE3.from_rotation_and_translation(rotation, center + radius * backward)


def rotation_error(a: Array, b: Array) -> Array:
    """Returns the angle of the rotation that leads from one rotation to another, f32[...] rad in [0, pi].

    This geodesic angle is atan2 of its sine and cosine, both from R = A^T B. The usual arccos of the trace loses half
    of the digits near 0.

    Args:
      a: f32[..., 3, 3], rotation matrices A.
      b: f32[..., 3, 3], rotation matrices B.
    """
    relative = jnp.swapaxes(a, -1, -2) @ b
    twice_cosine = jnp.trace(relative, axis1=-2, axis2=-1) - 1.0
    # ||R - R^T||_F^2 = 8 sin^2. The lower bound keeps the gradient of the root finite where the rotations agree.
    squared = jnp.sum((relative - jnp.swapaxes(relative, -1, -2)) ** 2, axis=(-2, -1))
    twice_sine = jnp.sqrt(jnp.maximum(squared, 1e-20) / 2.0)
    return jnp.arctan2(twice_sine, twice_cosine)


def symmetric_turn(a: Array, b: Array, order: int) -> Array:
    """Returns the turn about world z, one that maps a symmetric object to itself, that brings B nearest to A.

    The angle maximises trace(A^T Rz B), which is a cosine of the angle plus a constant. So the best turn of a symmetric
    object is the multiple of 2 pi / order that is nearest to the maximum.

    Args:
      a: f32[..., 3, 3], rotation matrices A.
      b: f32[..., 3, 3], rotation matrices B.
      order: number of turns about z that map the object to itself; 1 without symmetry, 0 for any turn.

    Returns:
      Angle of the turn, f32[...] rad.
    """
    product = b @ jnp.swapaxes(a, -1, -2)
    sine, cosine = product[..., 0, 1] - product[..., 1, 0], product[..., 0, 0] + product[..., 1, 1]
    best = jnp.arctan2(sine, cosine)
    if order == 0:
        return best
    step = 2.0 * jnp.pi / order
    return step * jnp.round(best / step)


def turn_about_z(angle: Array) -> Array:
    """Returns the rotation matrices f32[..., 3, 3] of turns about world z by `angle`, f32[...] rad."""
    return SO3.from_z_radians(angle).as_matrix()


def frobenius_angle(a: Array, b: Array) -> Array:
    """Returns the rotation error of the thesis (formula 3.2), f32[...] rad.

    It is arccos of a third of the Frobenius product of the two matrices. It is not the geodesic angle; see
    `rotation_error`. The argument of arccos is clipped to +-(1 - 1e-7), so the smallest error is about 5e-4 rad.

    Args:
      a: f32[..., 3, 3], rotation matrices.
      b: f32[..., 3, 3], rotation matrices.
    """
    product = jnp.sum(a * b, axis=(-2, -1)) / 3.0
    limit = 1.0 - 1e-7  # arccos has no gradient at 1 and -1
    return jnp.arccos(jnp.clip(product, -limit, limit))


def cosine_similarity(a: Array, b: Array) -> Array:
    """Returns the cosine of the angle between two codes (vectors that the encoder makes of images).

    The cosine is f32[...]. It is 0 where a code is all zeros.

    Args:
      a: f32[..., Z], codes of Z numbers each.
      b: f32[..., Z], codes of Z numbers each.
    """
    norms = jnp.sqrt(jnp.maximum(jnp.sum(a * a, axis=-1) * jnp.sum(b * b, axis=-1), 1e-24))
    return jnp.sum(a * b, axis=-1) / norms
