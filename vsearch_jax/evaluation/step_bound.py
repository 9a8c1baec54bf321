"""How few steps an episode can take, whatever the policy."""

from __future__ import annotations

import math

import jax.numpy as jnp
from jax import Array

from vsearch_jax.config import Config
from vsearch_jax.geometry import angle_difference, cosine_similarity
from vsearch_jax.types import Observation, View

GRID_AZIMUTHS, GRID_ELEVATIONS = 144, 13
"""Views on which the lower bound of an episode's steps looks for the threshold: every 2.5 degrees."""


def band_grid(band: Array) -> View:
    """Returns View of f32[N] rad: a grid over all azimuths and the elevations of `band` (f32[2] rad)."""
    azimuths = jnp.linspace(-jnp.pi, jnp.pi, GRID_AZIMUTHS, endpoint=False)
    elevations = jnp.linspace(band[0], band[1], GRID_ELEVATIONS)
    return View(*(x.reshape(-1) for x in jnp.meshgrid(azimuths, elevations)))


def steps_lower_bound(initial: View, target: Observation, grid: Observation, band: Array, config: Config) -> Array:
    """Returns i32[], fewer steps than which no policy can need: a bound for one episode.

    A step changes azimuth and elevation by at most `action_scale_deg` each. The episode ends at the nearest view that
    meets the threshold, which need not be the target. A whole spacing of the grid is subtracted: views within it of the
    target, or of one of the `grid`'s that meets the threshold, may meet it too.

    Args:
      initial: View of f32[] rad.
      target: Observation of the target.
      grid: Observation of f32[N, ...], of the views of `band_grid`.
      band: f32[2] rad, the elevations that `grid` spans.
      config: the run's.
    """
    azimuth_spacing = 2.0 * jnp.pi / GRID_AZIMUTHS
    elevation_spacing = (band[1] - band[0]) / (GRID_ELEVATIONS - 1)

    def way(view: View) -> Array:
        azimuth = jnp.abs(angle_difference(view.azimuth, initial.azimuth)) - azimuth_spacing
        return jnp.maximum(azimuth, jnp.abs(view.elevation - initial.elevation) - elevation_spacing)

    is_found = cosine_similarity(grid.code, target.code[None]) >= config.env.threshold
    to_grid = jnp.where(is_found, way(grid.view), jnp.inf).min()
    steps = jnp.minimum(to_grid, way(target.view)) / math.radians(config.env.action_scale_deg)
    return jnp.maximum(jnp.ceil(steps - 1e-5), 1.0).astype(jnp.int32)
