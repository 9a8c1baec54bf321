"""Views of the protocol, and the observation of views that are known before the search."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from vsearch_jax.config import Config
from vsearch_jax.env import ViewSearchEnv
from vsearch_jax.geometry import wrap_angle
from vsearch_jax.types import Observation, View


def initial_views(config: Config, band: Array) -> View:
    """Returns the views from which the evaluated random searches and CMA-ES searches start.

    The azimuths are evenly spaced, and half a spacing away from the axes. So each quadrant holds the same number.
    The elevations repeat 1/6, 3/6 and 5/6 of the reachable band.

    Args:
      config: the run's config; `evaluation.num_initial_views` is read.
      band: f32[2] rad, lowest and highest reachable elevation.

    Returns:
      The initial views: a View of f32[num_initial_views] rad.
    """
    number = jnp.arange(config.evaluation.num_initial_views, dtype=jnp.float32)
    azimuth = wrap_angle((number + 0.5) * (2.0 * jnp.pi / config.evaluation.num_initial_views))
    return View(azimuth, band[0] + (band[1] - band[0]) * (2.0 * (number % 3) + 1.0) / 6.0)


class ViewRequest(NamedTuple):
    """A request for the observation of one view.

    Attributes:
      view: View of f32[] rad.
      qpos: f32[nq] rad or m, preferred joints; IK returns the solution nearest to them.
      is_fixed: bool[]. If false, the nearest reachable view of the map replaces a view that the arm cannot reach.
    """

    view: View
    qpos: Array
    is_fixed: Array


class SeenView(NamedTuple):
    """What the wrist camera sees after a request. Arrays may have leading batch axes.

    Attributes:
      observation: what the camera sees. If the view is not reached, the joints in it have no meaning.
      is_reached: bool[], the arm reaches the view. False only if no other view may replace an unreachable one.
    """

    observation: Observation
    is_reached: Array


def observe_request(env: ViewSearchEnv, request: ViewRequest) -> SeenView:
    """Brings the camera to the requested view, and returns what it sees there.

    Args:
      env: the task.
      request: the view, preferred joint values, and whether a reachable view may replace an unreachable one.
    """
    view, qpos, is_reached = env.resolve_view(*request)
    return SeenView(env.observe_view(view, qpos), is_reached)
