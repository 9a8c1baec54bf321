"""Tests of the protocol: initial views, success, costs of the motions, unreachable targets."""

from __future__ import annotations

import dataclasses

import jax
import numpy as np
import pytest

import vsearch_jax as vs
from vsearch_jax import evaluation
from vsearch_jax.config import ConfigError, EvaluationConfig
from vsearch_jax.search import BLACK_BOX, LABELS, POLICIES

CONFIG = vs.Config.preset("smoke")


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


def test_results_have_one_entry_for_each_trial(results):
    trials = CONFIG.evaluation.num_initial_views * CONFIG.evaluation.num_runs
    for name in BLACK_BOX:
        assert results[name]["is_success"].shape == (trials,)
    for name in POLICIES:
        assert results[name]["is_success"].shape == (CONFIG.sac.num_seeds, CONFIG.evaluation.num_episodes)


@pytest.mark.parametrize("name", LABELS)
def test_success_meets_the_threshold_and_false_positives_are_distant_successes(results, name):
    outcome = results[name]
    np.testing.assert_array_equal(outcome["is_success"], outcome["final_cosine"] >= np.float32(CONFIG.env.threshold))
    is_distant = outcome["rotation_error"] > np.deg2rad(evaluation.FALSE_POSITIVE_DEG)
    np.testing.assert_array_equal(outcome["is_false_positive"], outcome["is_success"] & is_distant)
    assert (outcome["evaluations"] >= 1).all()
    best = outcome["best_scores"]  # -inf until a view is reached
    assert (best[..., 1:] >= best[..., :-1]).all()


@pytest.mark.parametrize("name", LABELS)
def test_motions_are_counted_and_respect_the_speed_limits(results, name):
    outcome = results[name]
    np.testing.assert_array_equal(outcome["num_plans"], outcome["evaluations"] - (name in BLACK_BOX))
    has_moved = outcome["num_plans"] > outcome["unreachable"]
    assert ((outcome["joint_travel"] > 0.0) == has_moved).all()
    assert ((outcome["motion_time"] > 0.0) == has_moved).all()
    # No joint of the LWR turns faster than 180 degrees per second. So the travel of all seven is at most sqrt(7) times
    # that.
    assert (outcome["joint_travel"] <= np.pi * np.sqrt(7) * outcome["motion_time"] + 1e-4).all()


def test_pose_errors_agree_with_the_views(results):
    outcome = results["random_search"]
    # The distance between two cameras on a sphere is at most its diameter.
    assert (outcome["translation_error"] <= 2 * CONFIG.scene.radius + 2e-3).all()
    # Formula 3.2 of the thesis, from the geodesic angle.
    is_small = outcome["rotation_error"] < 3.0
    np.testing.assert_allclose(
        np.cos(outcome["frobenius_angle"][is_small]),
        (1 + 2 * np.cos(outcome["rotation_error"][is_small])) / 3,
        atol=2e-3,
    )


def test_each_quadrant_holds_three_initial_views(state):
    config = dataclasses.replace(CONFIG, evaluation=EvaluationConfig(num_initial_views=12))
    views = evaluation.initial_views(config, state.reach.band)
    counts, _ = np.histogram(np.mod(views.azimuth, 2 * np.pi), bins=4, range=(0.0, 2 * np.pi))
    assert counts.tolist() == [3, 3, 3, 3]
    assert ((views.elevation > state.reach.band[0]) & (views.elevation < state.reach.band[1])).all()


def test_error_names_a_target_that_the_arm_cannot_reach(state):
    config = dataclasses.replace(CONFIG, evaluation=dataclasses.replace(CONFIG.evaluation, target_elevation_deg=89.0))
    with pytest.raises(ConfigError, match=r"target_elevation_deg is 89, which the arm cannot reach.*allowed"):
        vs.evaluate(state, config)
