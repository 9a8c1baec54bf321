"""Estimate of the lower bound on the number of steps of an episode."""

from __future__ import annotations

import math

import jax.numpy as jnp
from jax import Array

from vsearch_jax.config import Config
from vsearch_jax.evaluation.views import SeenView
from vsearch_jax.geometry import angle_difference, cosine_similarity
from vsearch_jax.types import Observation, View

GRID_AZIMUTHS, GRID_ELEVATIONS = 144, 13
"""Size of the grid over the band. 144 azimuths are 2.5 degrees apart."""


def band_grid(band: Array) -> View:
    """Returns a grid of views over all azimuths and the elevations of the reachable band, for `steps_lower_bound`.

    Args:
      band: f32[2] rad, lowest and highest elevation of the grid.

    Returns:
      The N = `GRID_AZIMUTHS` * `GRID_ELEVATIONS` views: a View of f32[N] rad.
    """
    azimuths = jnp.linspace(-jnp.pi, jnp.pi, GRID_AZIMUTHS, endpoint=False)
    elevations = jnp.linspace(band[0], band[1], GRID_ELEVATIONS)
    return View(*(x.reshape(-1) for x in jnp.meshgrid(azimuths, elevations)))


def steps_lower_bound(initial: View, target: Observation, grid: SeenView, band: Array, config: Config) -> Array:
    """Estimates a lower bound on the number of steps that any policy needs in one episode.

    A step changes azimuth and elevation by at most `action_scale_deg` each. The episode ends at any view whose code
    meets the threshold, so the bound takes the nearest such view: the target, or a view of the grid. Views between
    the grid's points may meet the threshold too. So one grid spacing is subtracted from every distance.

    The result is an estimate and no proof: the code of a view depends a little on the arm's configuration, and each
    view of the grid has one. `below_bound_rate` in `results.json` counts the episodes that need fewer steps.

    Args:
      initial: initial view of the episode, f32[] rad.
      target: what the camera sees from the target view.
      grid: what the camera sees from the N views of `band_grid`: arrays [N, ...].
      band: f32[2] rad, lowest and highest elevation of the grid.
      config: `env.threshold` and `env.action_scale_deg` are read.

    Returns:
      Estimate of the lower bound, i32[], at least 1.
    """
    azimuth_spacing = 2.0 * jnp.pi / GRID_AZIMUTHS
    elevation_spacing = (band[1] - band[0]) / (GRID_ELEVATIONS - 1)

    def angle_to(view: View) -> Array:
        """Returns the larger of the changes of azimuth and elevation in rad, less one grid spacing."""
        azimuth = jnp.abs(angle_difference(view.azimuth, initial.azimuth)) - azimuth_spacing
        return jnp.maximum(azimuth, jnp.abs(view.elevation - initial.elevation) - elevation_spacing)

    is_found = cosine_similarity(grid.observation.code, target.code[None]) >= config.env.threshold
    to_grid = jnp.where(is_found & grid.is_reached, angle_to(grid.observation.view), jnp.inf).min()
    steps = jnp.minimum(to_grid, angle_to(target.view)) / math.radians(config.env.action_scale_deg)
    return jnp.maximum(jnp.ceil(steps - 1e-5), 1.0).astype(jnp.int32)
