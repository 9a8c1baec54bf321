"""Loss on known poses: the cosine of two codes shall be a function of the angle between their views.

The renderer knows the pose of each image. So no decoder is needed, and views of a plain object that look alike are
pushed apart.
"""

from __future__ import annotations

import math

import jax.numpy as jnp
from jax import Array

from vsearch_jax.config import Config
from vsearch_jax.geometry import rotation_error, symmetric_turn, turn_about_z

_NEAR_WIDTHS = 2.0
"""Pairs of views closer than this number of kernel widths count as near."""
_NEAR_WEIGHT = 6.0
"""Weight of near pairs. The threshold is among them, so their distances must be more exact than those of far pairs.

Measured on the gear of eval/parts.py: with 10 far views have cosines up to 0.93, with 4 up to 0.84; with 4 views near
the threshold differ more under the arm's shadow.
"""
_NEAR_ERROR = 0.1
"""Error of the distance of two near codes of length 1, at which its cost turns from quadratic to linear.

An occlusion can hide the one mark by which an object's sides differ. Such pairs have large errors whatever the encoder
does, and their squares would outweigh the errors at the threshold.
"""
_DISTANCE_FLOOR = 1e-3
"""Added to squared distances, so that the gradient of a distance of 0 is finite."""


def kernel_width(config: Config) -> float:
    """Returns the width in rad of the narrow part of the wanted cosine.

    It is such that the wanted cosine equals `env.threshold` at `encoder.threshold_angle_deg`.

    Args:
      config: the run's config.
    """
    angle, wide = math.radians(config.encoder.threshold_angle_deg), config.encoder.wide_weight
    narrow = (config.env.threshold - wide * math.cos(angle)) / (1.0 - wide)
    return angle / math.sqrt(-2.0 * math.log(narrow))


def wanted_cosine(angle: Array, config: Config) -> Array:
    """Returns the cosine that two codes shall have: (1 - w) exp(-angle^2 / (2 width^2)) + w cos(angle).

    The narrow part makes the threshold mean a stated angle. The wide part, of weight w = `encoder.wide_weight`, leads
    searches back from the far side.

    Args:
      angle: f32[...] rad, angles between views.
      config: the run's config.

    Returns:
      Wanted cosines, f32[...].
    """
    wide = config.encoder.wide_weight
    return (1.0 - wide) * jnp.exp(-0.5 * (angle / kernel_width(config)) ** 2) + wide * jnp.cos(angle)


def view_angles(rotations: Array, order: int) -> Array:
    """Computes the angles between all pairs of B views, to the nearest symmetric pose of the object.

    Args:
      rotations: f32[B, 3, 3], rotations of the cameras, camera to world.
      order: number of turns about z that map the object to itself; see `geometry.symmetric_turn`.

    Returns:
      Rotation errors, f32[B, B] rad.
    """
    first, second = rotations[:, None], rotations[None]
    if order != 1:
        second = turn_about_z(symmetric_turn(first, second, order)) @ second
    return rotation_error(first, second)


def pose_loss(latents: Array, angles: Array, config: Config) -> Array:
    """Computes the pose loss of a batch: by how much cosines and distances of codes differ from the wanted ones.

    Far pairs cost the squared error of their cosine. Near pairs cost the pseudo-Huber loss of the error of the distance
    between codes of length 1: there a cosine hardly changes with the angle, but a distance does.

    Near pairs are rare among random views. So the weighted mean over near pairs and the mean over far pairs are added.

    Args:
      latents: f32[B, Z], raw latents of B views, Z numbers each.
      angles: f32[B, B] rad, angles between the views, from `view_angles`.
      config: the run's config.

    Returns:
      Loss, f32[].
    """
    cosines, wanted = code_cosines(latents), wanted_cosine(angles, config)
    distance_errors = _distance(cosines) - _distance(wanted)
    near_costs = _NEAR_ERROR * (jnp.sqrt(_NEAR_ERROR**2 + distance_errors**2) - _NEAR_ERROR)
    is_near = angles < _NEAR_WIDTHS * kernel_width(config)
    is_other = ~jnp.eye(angles.shape[0], dtype=bool)
    near_loss = _mean_where(is_near & is_other, near_costs)
    return _NEAR_WEIGHT * near_loss + _mean_where(~is_near & is_other, (cosines - wanted) ** 2)


def code_cosines(codes: Array) -> Array:
    """Returns the cosines f32[B, B] between all pairs of B codes or raw latents, f32[B, Z]."""
    unit = codes / jnp.sqrt(jnp.maximum(jnp.sum(codes**2, axis=-1, keepdims=True), 1e-12))
    return unit @ unit.T


def match_metrics(codes: Array, angles: Array, config: Config, limit_deg: float) -> dict[str, Array]:
    """Measures how well codes tell B views apart. Two views match if their cosine meets `env.threshold`.

    Args:
      codes: f32[B, Z], codes of B views that were not trained on.
      angles: f32[B, B] rad, angles between the views, from `view_angles`.
      config: the run's config.
      limit_deg: a match whose angle is larger is false.

    Returns:
      `false_match_rate` f32[], share of the matches that are false, NaN without a match. `threshold_angle_deg` f32[],
      angle in degrees at which the cosine meets the threshold, NaN without pairs within the limit. It is a fit to these
      pairs: 1 - cosine grows with the square of the angle.
    """
    is_other = ~jnp.eye(angles.shape[0], dtype=bool)
    cosines = code_cosines(codes)
    is_match = (cosines >= config.env.threshold) & is_other
    is_false = is_match & (angles > math.radians(limit_deg))
    is_near = is_other & (angles <= math.radians(limit_deg))
    slope = jnp.sum(jnp.where(is_near, 1.0 - cosines, 0.0)) / jnp.sum(jnp.where(is_near, angles**2, 0.0))
    return {
        "false_match_rate": jnp.sum(is_false) / jnp.sum(is_match),
        "threshold_angle_deg": jnp.rad2deg(jnp.sqrt((1.0 - config.env.threshold) / slope)),
    }


def _distance(cosines: Array) -> Array:
    """Returns the distances f32[...] between codes of length 1 that have the given cosines, f32[...]."""
    return jnp.sqrt(2.0 * jnp.maximum(1.0 - cosines, 0.0) + _DISTANCE_FLOOR)


def _mean_where(is_wanted: Array, values: Array) -> Array:
    """Returns the mean of the wanted values, or 0 if there is none."""
    count = jnp.sum(is_wanted).astype(jnp.float32)
    return jnp.sum(jnp.where(is_wanted, values, 0.0)) / jnp.maximum(count, 1.0)
