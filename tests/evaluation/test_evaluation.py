"""Tests of the protocol: initial views, success, costs of the motions, unreachable targets."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace
from typing import cast

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import vsearch_jax as vs
from vsearch_jax import evaluation
from vsearch_jax.config import ConfigError, EvaluationConfig
from vsearch_jax.env import UnreachableError, zero_observation
from vsearch_jax.evaluation import protocol
from vsearch_jax.scene import build_scene
from vsearch_jax.search import BLACK_BOX, LABELS, POLICIES
from vsearch_jax.types import View

CONFIG = vs.Config.preset("smoke")


@pytest.fixture(scope="module")
def state():
    """An untrained run whose codes are centred, so that cosines differ: some searches succeed, others do not."""
    start = vs.init(jax.random.key(0), CONFIG)
    env = vs.ViewSearchEnv(CONFIG, start.encoder, start.reach)

    def random_latent(key):
        view, qpos = env.random_view(key)
        return env.observe_latent(env.resolve_view(view, qpos, jnp.bool_(False))[1])[1]

    latents = jax.jit(jax.vmap(random_latent))(jax.random.split(jax.random.key(1), 64))
    return start.replace(encoder=dataclasses.replace(start.encoder, latent_mean=latents.mean(axis=0)))


@pytest.fixture(scope="module")
def raw_latents(state):
    """Returns a function from joint values f32[N, nq] to the encoder's outputs f32[N, Z]."""
    env = vs.ViewSearchEnv(CONFIG, state.encoder, state.reach)
    latents = jax.jit(jax.vmap(lambda qpos: env.observe_latent(qpos)[1]))
    return lambda qpos: np.asarray(latents(qpos))


def joints_of(outcome, name):
    """Returns `final_qpos` or `target_qpos` of all searches, f32[N, nq]."""
    return outcome[name].reshape(-1, outcome[name].shape[-1])


def camera_poses(qpos):
    """Returns positions f64[N, 3] m and rotations of the wrist camera, computed by C MuJoCo."""
    scene = build_scene(CONFIG.scene)
    data, poses = mujoco.MjData(scene.mj_model), []
    for joints in qpos:
        data.qpos[:] = joints
        mujoco.mj_forward(scene.mj_model, data)
        poses.append((data.cam_xpos[scene.camera_id].copy(), data.cam_xmat[scene.camera_id].reshape(3, 3).copy()))
    positions, rotations = zip(*poses, strict=True)
    return np.array(positions), Rotation.from_matrix(np.array(rotations))


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
def test_a_search_succeeds_where_the_images_of_its_end_and_of_the_target_have_like_codes(
    results, state, raw_latents, name
):
    outcome = results[name]
    mean = np.asarray(state.encoder.latent_mean)
    final, target = (raw_latents(joints_of(outcome, key)) - mean for key in ("final_qpos", "target_qpos"))
    cosine = np.sum(final * target, axis=-1) / np.linalg.norm(final, axis=-1) / np.linalg.norm(target, axis=-1)
    np.testing.assert_allclose(outcome["final_cosine"].ravel(), cosine, atol=1e-4)
    is_clear = np.abs(cosine - CONFIG.env.threshold) > 1e-4
    is_success = outcome["is_success"].ravel()
    np.testing.assert_array_equal(is_success[is_clear], cosine[is_clear] >= CONFIG.env.threshold)
    best = outcome["best_scores"]  # -inf until a view is reached
    assert (best[..., 1:] >= best[..., :-1]).all()
    assert (outcome["evaluations"] >= 1).all()


def test_some_searches_succeed_and_some_do_not(results):
    is_success = np.concatenate([results[name]["is_success"].ravel() for name in LABELS])
    assert 0.0 < is_success.mean() < 1.0  # or the tests of success could not fail


@pytest.mark.parametrize("name", LABELS)
def test_pose_errors_are_those_of_the_cameras_in_c_mujoco(results, name):
    outcome = results[name]
    (position, rotation), (target_position, target_rotation) = (
        camera_poses(joints_of(outcome, key)) for key in ("final_qpos", "target_qpos")
    )
    angle = (rotation.inv() * target_rotation).magnitude()
    distance = np.linalg.norm(position - target_position, axis=-1)
    np.testing.assert_allclose(outcome["rotation_error"].ravel(), angle, atol=1e-3)
    np.testing.assert_allclose(outcome["translation_error"].ravel(), distance, atol=1e-4)
    is_distant = angle > np.deg2rad(evaluation.FALSE_POSITIVE_DEG)
    np.testing.assert_array_equal(outcome["is_false_positive"].ravel(), outcome["is_success"].ravel() & is_distant)


@pytest.mark.parametrize("name", LABELS)
def test_motions_are_counted_and_respect_the_speed_limits(results, name):
    outcome = results[name]
    np.testing.assert_array_equal(outcome["num_plans"], outcome["evaluations"] - (name in BLACK_BOX))
    has_moved = outcome["num_plans"] > outcome["unreachable"]
    assert has_moved.any()
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


def test_views_for_which_inverse_kinematics_fails_are_flagged():
    """A stand-in for the task, which reaches no elevation between 0.9 and 1.0; the target is one of them."""

    def resolve_view(view, qpos, is_fixed):
        is_reached = jnp.abs(view.elevation - 0.95) > 0.05
        return view, qpos, is_reached | ~is_fixed

    task = SimpleNamespace(
        config=CONFIG,
        reach=SimpleNamespace(band=jnp.array([0.8, 1.2])),
        random_joints=lambda key: jnp.zeros(2),
        random_view=lambda key: (View(*jax.random.uniform(key, (2,))), jnp.zeros(2)),
        resolve_view=resolve_view,
        observe_view=lambda view, qpos: dataclasses.replace(zero_observation(3, 2), view=view, code=jnp.ones(3)),
    )
    keys = jax.random.split(jax.random.key(0), (1, 4, 2))
    observe = jax.jit(lambda *keys: protocol.observe_known_views(*keys, cast(vs.ViewSearchEnv, task), CONFIG))
    known = observe(jax.random.key(1), keys)
    assert 0.9 < float(known.target.observation.view.elevation) < 1.0
    for seen in known[:3]:
        elevation = np.asarray(seen.observation.view.elevation)
        np.testing.assert_array_equal(seen.is_reached, np.abs(elevation - 0.95) > 0.05)
        assert (np.asarray(seen.observation.code) == 1.0).all()
    assert 0 < np.sum(known.grid.is_reached) < known.grid.is_reached.size
    assert known.ends.code.shape == (1, 4, 2, 3)


def test_an_evaluation_without_a_target_image_is_an_error(state, monkeypatch: pytest.MonkeyPatch):
    for is_reached in (True, False):
        monkeypatch.setattr(protocol, "_evaluate", lambda *_, flag=is_reached: ({"sac": {}}, jnp.bool_(flag)))
        if is_reached:
            assert vs.evaluate(state, CONFIG) == {"sac": {}}
        else:
            with pytest.raises(UnreachableError, match=r"target_azimuth_deg 60 .* evaluate with another target"):
                vs.evaluate(state, CONFIG)
