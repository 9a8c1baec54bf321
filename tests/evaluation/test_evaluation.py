"""The protocol: who starts where, what counts as found, and the bound that no policy beats."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import vsearch_jax as vs
from vsearch_jax import evaluation
from vsearch_jax.config import ConfigError, EvaluationConfig
from vsearch_jax.evaluation import step_bound
from vsearch_jax.types import Observation, View

CONFIG = vs.Config.preset("smoke")
BOUND = jax.jit(lambda *args: step_bound.steps_lower_bound(*args, CONFIG))


def observation(view, code):
    """Returns a Observation of which only view and code are read."""
    return Observation(view=view, qpos=None, camera=None, code=code)


@pytest.fixture(scope="module")
def state():
    return vs.init(jax.random.key(0), CONFIG)


@pytest.fixture(
    scope="module",
    params=[
        ("ik", "kinematic"),
        pytest.param(("path", "kinematic"), marks=pytest.mark.slow),
        pytest.param(("path", "dynamic"), marks=pytest.mark.slow),
    ],
    ids="-".join,
)
def results(state, request):
    reachable, motion = request.param
    task = dataclasses.replace(CONFIG.env, reachable=reachable, motion=motion)
    return jax.tree.map(np.asarray, vs.evaluate(state, dataclasses.replace(CONFIG, env=task)))


def test_shapes(results):
    trials = CONFIG.evaluation.num_initial_views * CONFIG.evaluation.num_runs
    for name in ("random_search", "cma_es"):
        assert results[name]["is_success"].shape == (trials,)
    assert results["sac"]["is_success"].shape == (CONFIG.sac.num_seeds, CONFIG.evaluation.num_episodes)


@pytest.mark.parametrize("name", ["random_search", "cma_es", "sac"])
def test_success_means_the_threshold_and_false_positives_are_far_successes(results, name):
    r = results[name]
    np.testing.assert_array_equal(r["is_success"], r["final_cosine"] >= np.float32(CONFIG.env.threshold))
    is_far = r["rotation_error"] > np.deg2rad(evaluation.FALSE_POSITIVE_DEG)
    np.testing.assert_array_equal(r["is_false_positive"], r["is_success"] & is_far)
    assert (r["evaluations"] >= 1).all()
    assert (np.diff(r["best_scores"], axis=-1) >= 0.0).all()


@pytest.mark.parametrize("name", ["random_search", "cma_es", "sac"])
def test_motions_are_counted_and_cost_what_the_speeds_allow(results, name):
    r = results[name]
    np.testing.assert_array_equal(r["num_plans"], r["evaluations"] - (name != "sac"))
    has_moved = r["num_plans"] > r["unreachable"]
    assert ((r["joint_travel"] > 0.0) == has_moved).all() and ((r["motion_time"] > 0.0) == has_moved).all()
    # No joint of the LWR turns faster than 180 degrees a second, so seven together cover sqrt(7) times that.
    assert (r["joint_travel"] <= np.pi * np.sqrt(7) * r["motion_time"] + 1e-4).all()


def test_pose_errors_agree_with_the_views(results):
    r = results["random_search"]
    # On a sphere the way between two cameras can't be longer than its diameter, and the thesis's angle is the geodesic.
    assert (r["translation_error"] <= 2 * CONFIG.scene.radius + 2e-3).all()
    small = r["rotation_error"] < 3.0
    np.testing.assert_allclose(
        np.cos(r["frobenius_angle"][small]), (1 + 2 * np.cos(r["rotation_error"][small])) / 3, atol=2e-3
    )


def test_initial_views_are_three_a_quadrant(state):
    config = dataclasses.replace(CONFIG, evaluation=EvaluationConfig(num_initial_views=12))
    views = evaluation.initial_views(config, state.reach.band)
    counts, _ = np.histogram(np.mod(views.azimuth, 2 * np.pi), bins=4, range=(0.0, 2 * np.pi))
    assert counts.tolist() == [3, 3, 3, 3]
    assert ((views.elevation > state.reach.band[0]) & (views.elevation < state.reach.band[1])).all()


@given(st.floats(-3.1, 3.1), st.floats(0.7, 1.2), st.floats(-3.1, 3.1), st.floats(0.7, 1.2))
def test_bound_is_the_steps_to_the_target_where_only_it_is_found(azimuth, elevation, target_azimuth, target_elevation):
    code = jnp.ones(4)
    target = observation(View(jnp.float32(target_azimuth), jnp.float32(target_elevation)), code)
    nowhere = observation(View(jnp.zeros(1), jnp.ones(1)), -jnp.ones((1, 4)))
    initial = View(jnp.float32(azimuth), jnp.float32(elevation))
    # Less one spacing of the grid, 360 / 144 degrees and a twelfth of the band.
    turn = np.abs(np.angle(np.exp(1j * (target_azimuth - azimuth)))) - np.deg2rad(2.5)
    steps = max(turn, abs(target_elevation - elevation) - 0.5 / 12) / np.deg2rad(30.0)
    steps_at_least = step_bound.steps_lower_bound(initial, target, nowhere, jnp.array([0.7, 1.2]), CONFIG)
    assert int(steps_at_least) in {max(1, int(np.ceil(steps - 1e-4))), max(1, int(np.ceil(steps + 1e-4)))}


def repeating_code(view):
    """A code whose cosine is 0.98 at 4 degrees; views 120 degrees of azimuth apart look alike."""
    angles = 3.0 * jnp.stack([view.azimuth, view.elevation], axis=-1)
    return jnp.concatenate([jnp.cos(angles), jnp.sin(angles)], axis=-1)


@given(st.tuples(*[st.floats(-3.1, 3.1), st.floats(0.7, 1.2)] * 3))
def test_no_way_to_a_view_that_meets_the_threshold_is_shorter_than_the_bound(numbers):
    views = [View(*(jnp.float32(x) for x in numbers[i : i + 2])) for i in (0, 2, 4)]
    initial, target, end = views
    # The end lies 3 degrees from the target or from a view that looks like it.
    offset = jnp.deg2rad(3.0) / jnp.sqrt(2.0)
    turns = jnp.round(end.azimuth) * jnp.deg2rad(120.0)
    end = View(target.azimuth + turns + offset, jnp.clip(target.elevation - offset, 0.7, 1.2))
    band = jnp.array([0.7, 1.2])
    grid = step_bound.band_grid(band)
    observations = [observation(view, repeating_code(view)) for view in (target, grid)]
    code = repeating_code(end)
    assert code @ observations[0].code >= 0.98 * 2.0
    turn = np.abs(np.angle(np.exp(1j * (float(end.azimuth) - numbers[0]))))
    steps = max(1, int(np.ceil(max(turn, abs(float(end.elevation) - numbers[1])) / np.deg2rad(30.0) - 1e-4)))
    steps_at_least = int(BOUND(initial, *observations, band))
    assert steps_at_least <= steps
    # Nor is it slack: no view that looks alike is further than 60 degrees of azimuth.
    assert steps_at_least <= 2


def test_bound_takes_the_nearest_view_that_meets_the_threshold():
    code = jnp.ones(4)
    target = observation(View(jnp.float32(3.0), jnp.float32(1.0)), code)
    grid = observation(View(jnp.array([0.3, 1.0]), jnp.ones(2)), jnp.stack([code, -code]))
    steps_at_least = step_bound.steps_lower_bound(
        View(jnp.float32(0.0), jnp.float32(1.0)), target, grid, jnp.array([0.7, 1.2]), CONFIG
    )
    assert int(steps_at_least) == 1


def test_a_target_that_the_arm_cannot_reach_is_named(state):
    config = dataclasses.replace(CONFIG, evaluation=dataclasses.replace(CONFIG.evaluation, target_elevation_deg=89.0))
    with pytest.raises(ConfigError, match=r"target_elevation_deg is 89, which the arm cannot reach.*allowed"):
        vs.evaluate(state, config)
