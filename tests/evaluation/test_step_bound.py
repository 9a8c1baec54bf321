"""Tests of the lower bound on the number of steps."""

from __future__ import annotations

import functools
from typing import cast

import jax
import jax.numpy as jnp
import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from jax import Array

import vsearch_jax as vs
from vsearch_jax.evaluation import step_bound
from vsearch_jax.evaluation.views import SeenView
from vsearch_jax.types import Camera, Observation, View

CONFIG = vs.Config.preset("smoke")
BAND = jnp.array([0.7, 1.2])
steps_lower_bound = jax.jit(functools.partial(step_bound.steps_lower_bound, config=CONFIG))


def make_view(azimuth: float, elevation: float) -> View:
    return View(jnp.float32(azimuth), jnp.float32(elevation))


def make_observation(view: View, code: Array) -> Observation:
    """Returns an Observation with view and code only; the bound reads nothing else."""
    return Observation(view=view, qpos=cast("Array", None), camera=cast("Camera", None), code=code)


@given(st.floats(-3.1, 3.1), st.floats(0.7, 1.2), st.floats(-3.1, 3.1), st.floats(0.7, 1.2))
def test_bound_is_the_steps_to_the_target_if_no_grid_view_meets_the_threshold(
    azimuth, elevation, target_azimuth, target_elevation
):
    code = jnp.ones(4)
    target = make_observation(make_view(target_azimuth, target_elevation), code)
    grid = make_grid(View(jnp.zeros(1), jnp.ones(1)), -jnp.ones((1, 4)))
    # The bound subtracts one spacing of the grid: 360 / 144 degrees, and a twelfth of the band.
    turn = np.abs(np.angle(np.exp(1j * (target_azimuth - azimuth)))) - np.deg2rad(2.5)
    steps = max(turn, abs(target_elevation - elevation) - 0.5 / 12) / np.deg2rad(30.0)
    bound = step_bound.steps_lower_bound(make_view(azimuth, elevation), target, grid, BAND, CONFIG)
    assert int(bound) in {max(1, int(np.ceil(steps - 1e-4))), max(1, int(np.ceil(steps + 1e-4)))}


def make_grid(view: View, code: Array, is_reached: bool = True) -> SeenView:
    return SeenView(make_observation(view, code), jnp.full(view.azimuth.shape, is_reached))


def repeating_code(view: View) -> Array:
    """Returns a code whose cosine is 0.98 at a distance of 4 degrees, and that repeats every 120 degrees of azimuth."""
    angles = 3.0 * jnp.stack([view.azimuth, view.elevation], axis=-1)
    return jnp.concatenate([jnp.cos(angles), jnp.sin(angles)], axis=-1)


@given(st.tuples(*[st.floats(-3.1, 3.1), st.floats(0.7, 1.2)] * 3))
def test_no_view_that_meets_the_threshold_is_nearer_than_the_bound(numbers):
    initial, target, end = (make_view(*numbers[i : i + 2]) for i in (0, 2, 4))
    # The end lies 3 degrees from the target, or from a view with the same code.
    offset = jnp.deg2rad(3.0) / jnp.sqrt(2.0)
    turns = jnp.round(end.azimuth) * jnp.deg2rad(120.0)
    end = View(target.azimuth + turns + offset, jnp.clip(target.elevation - offset, 0.7, 1.2))
    grid = step_bound.band_grid(BAND)
    seen = make_observation(target, repeating_code(target)), make_grid(grid, repeating_code(grid))
    assert repeating_code(end) @ seen[0].code >= 0.98 * 2.0
    turn = np.abs(np.angle(np.exp(1j * (float(end.azimuth) - numbers[0]))))
    steps = max(1, int(np.ceil(max(turn, abs(float(end.elevation) - numbers[1])) / np.deg2rad(30.0) - 1e-4)))
    bound = int(steps_lower_bound(initial, *seen, BAND))
    assert bound <= steps
    # The bound is tight too: a view with the same code is at most 60 degrees of azimuth away.
    assert bound <= 2


def test_bound_takes_the_nearest_view_that_meets_the_threshold():
    code = jnp.ones(4)
    target = make_observation(make_view(3.0, 1.0), code)
    views, codes = View(jnp.array([0.3, 1.0]), jnp.ones(2)), jnp.stack([code, -code])
    for is_reached, wanted in ((True, 1), (False, 6)):
        grid = make_grid(views, codes, is_reached)
        assert int(step_bound.steps_lower_bound(make_view(0.0, 1.0), target, grid, BAND, CONFIG)) == wanted
