"""View sphere, look-at, rotation errors; every function is finite with finite gradients at its degenerate points."""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array
from jaxlie import SE3, SO3

from vsearch_jax.types import View


def wrap_angle(angle: Array) -> Array:
    """Returns `angle` (rad, any shape) wrapped into [-pi, pi)."""
    return jnp.mod(angle + jnp.pi, 2.0 * jnp.pi) - jnp.pi


def angle_difference(a: Array, b: Array) -> Array:
    """Returns the signed shortest way in rad, in [-pi, pi), from angle `b` to angle `a` (rad, any shape)."""
    return wrap_angle(a - b)


def view_pose(view: View, center: Array, radius: float | Array) -> SE3:
    """Returns `T_world_camera` of the camera that looks at `center` from `view`.

    The camera's x axis stays level, so the pose is defined at the pole too, where it is the limit along the azimuth.

    Args:
      view: View of f32[] rad.
      center: f32[3] m in world, the middle of the view sphere.
      radius: f32[] m.
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
    """Returns the geodesic angle in rad, in [0, pi], between rotation matrices `a` and `b` (f32[..., 3, 3]).

    The angle comes from atan2 of sine and cosine, since arccos of the trace loses half the digits near 0.
    """
    relative = jnp.swapaxes(a, -1, -2) @ b
    twice_cosine = jnp.trace(relative, axis1=-2, axis2=-1) - 1.0
    # ||R - R^T||_F^2 = 8 sin^2; the floor keeps the gradient of the root finite where the rotations agree.
    squared = jnp.sum((relative - jnp.swapaxes(relative, -1, -2)) ** 2, axis=(-2, -1))
    twice_sine = jnp.sqrt(jnp.maximum(squared, 1e-20) / 2.0)
    return jnp.arctan2(twice_sine, twice_cosine)


def frobenius_angle(a: Array, b: Array) -> Array:
    """Returns formula 3.2 of the thesis in rad, arccos of a third of the Frobenius product (f32[..., 3, 3] each)."""
    product = jnp.sum(a * b, axis=(-2, -1)) / 3.0
    limit = 1.0 - 1e-7  # arccos has no gradient at its ends
    return jnp.arccos(jnp.clip(product, -limit, limit))


def cosine_similarity(a: Array, b: Array) -> Array:
    """Returns the cosine of codes `a` and `b` (f32[..., Z]); 0 where either is all zeros."""
    norms = jnp.sqrt(jnp.maximum(jnp.sum(a * a, axis=-1) * jnp.sum(b * b, axis=-1), 1e-24))
    return jnp.sum(a * b, axis=-1) / norms
