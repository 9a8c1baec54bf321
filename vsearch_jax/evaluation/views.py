"""Views of the protocol, and what is seen from views that are known before the search."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from vsearch_jax.config import Config
from vsearch_jax.env import ViewSearchEnv
from vsearch_jax.geometry import wrap_angle
from vsearch_jax.types import Observation, View


def initial_views(config: Config, band: Array) -> View:
    """Returns View of f32[num_initial_views]: even in azimuth, elevations spread over the band.

    Azimuths lie half a spacing off the axes, equally many in each quadrant; elevations step through 1/6, 3/6 and 5/6 of
    the band (f32[2] rad).
    """
    number = jnp.arange(config.evaluation.num_initial_views, dtype=jnp.float32)
    azimuth = wrap_angle((number + 0.5) * (2.0 * jnp.pi / config.evaluation.num_initial_views))
    return View(azimuth, band[0] + (band[1] - band[0]) * (2.0 * (number % 3) + 1.0) / 6.0)


def protocol_target(config: Config) -> View:
    """Returns the target view of random search and CMA-ES, f32[] rad."""
    settings = config.evaluation
    return View(wrap_angle(jnp.deg2rad(settings.target_azimuth_deg)), jnp.deg2rad(settings.target_elevation_deg))


class ViewRequest(NamedTuple):
    """A view to look at.

    Attributes:
      view: View of f32[] rad.
      qpos: f32[nq] rad or m, joints near which the arm is to stand, however it is come by.
      is_fixed: bool[]: where the arm does not reach the view, no other will do.
    """

    view: View
    qpos: Array
    is_fixed: Array


def observe_request(env: ViewSearchEnv, asked: ViewRequest) -> Observation:
    """Returns what is seen from a view, or from the nearest one of the map if any will do.

    The code of a fixed view that is not reached is 0, which matches nothing.
    """
    view, qpos, is_reached = env.resolve_view(*asked)
    observation = env.observe_view(view, qpos)
    code = jnp.where(is_reached, observation.code, 0.0)
    return observation.replace(code=code)  # pyright: ignore[reportAttributeAccessIssue] # flax adds it
