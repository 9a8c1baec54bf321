"""The view-search task against section 4.3 of the thesis, C MuJoCo's kinematics and brax's wrappers."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from brax.envs.wrappers.training import EpisodeWrapper, wrap
from scipy.spatial.transform import Rotation

import vsearch_jax as vs
from vsearch_jax.config import ConfigError
from vsearch_jax.env import pose_error
from vsearch_jax.geometry import cosine_similarity, view_pose

CONFIG = vs.Config.preset("smoke")


@pytest.fixture(scope="module")
def env():
    return vs.ViewSearchEnv(CONFIG)


@pytest.fixture(scope="module")
def reset(env):
    return jax.jit(env.reset)


@pytest.fixture(scope="module")
def step(env):
    return jax.jit(env.step)


@pytest.fixture
def with_implicit_promotion():
    """Allows promotion of types and ranks, which brax relies on."""
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        yield


def test_obs_and_action_have_the_documented_size_and_layout(env, reset):
    assert (env.observation_size, env.action_size) == (265, 2)
    state = reset(jax.random.key(0))
    assert state.obs.shape == (265,)
    observation, target = state.pipeline_state.observation, state.pipeline_state.target
    np.testing.assert_array_equal(state.obs, np.concatenate([observation.code, target.code, observation.qpos]))


def test_missing_band_raises_an_error_naming_arm_and_height(env):
    without_band = env.reach.replace(band=jnp.full(2, jnp.nan))
    with pytest.raises(ConfigError, match=r"'lwr' .*mount_height 1.355 reaches no elevation at every azimuth"):
        vs.ViewSearchEnv(CONFIG, env.encoder, without_band)
    for function in (vs.train, vs.evaluate):
        with pytest.raises(ConfigError, match="reaches no elevation"):
            function(SimpleNamespace(reach=without_band), CONFIG)


def test_reset_draws_initial_view_and_target_over_the_whole_band(env, reset):
    keys = jax.random.split(jax.random.key(1), 32)
    states = [reset(key) for key in keys]
    elevations = np.array([s.pipeline_state.observation.view.elevation for s in states])
    azimuths = np.array([s.pipeline_state.target.view.azimuth for s in states])
    low, high = np.asarray(env.reach.band)
    assert ((elevations >= low - 1e-6) & (elevations <= high + 1e-6)).all()
    assert np.ptp(elevations) > 0.5 * (high - low)
    assert (np.histogram(azimuths, bins=4, range=(-np.pi, np.pi))[0] > 0).all()


def test_camera_pose_equals_c_mujoco_and_is_within_tolerance_of_the_view(env, reset):
    observation = reset(jax.random.key(2)).pipeline_state.observation
    model = env.scene.mj_model
    data = mujoco.MjData(model)
    data.qpos[:] = observation.qpos
    mujoco.mj_forward(model, data)
    np.testing.assert_allclose(observation.camera.position, data.cam_xpos[env.scene.camera_id], atol=1e-5)
    np.testing.assert_allclose(observation.camera.rotation.reshape(-1), data.cam_xmat[env.scene.camera_id], atol=1e-5)
    assert data.ncon == 0
    commanded = view_pose(observation.view, env.center, env.scene.radius)
    assert np.linalg.norm(commanded.translation() - observation.camera.position) < CONFIG.ik.position_tolerance
    wanted = Rotation.from_matrix(commanded.rotation().as_matrix())
    reached = Rotation.from_matrix(data.cam_xmat[env.scene.camera_id].reshape(3, 3))
    # IK ends below the tolerance in f32; C MuJoCo's f64 pose may differ by rounding.
    assert np.rad2deg((wanted.inv() * reached).magnitude()) < CONFIG.ik.rotation_tolerance_deg + 1e-3


def test_step_moves_by_the_scaled_action_and_the_reward_is_cosine_minus_one(env, reset, step):
    state = reset(jax.random.key(3))
    before = state.pipeline_state
    inward = np.sign(np.mean(env.reach.band) - before.observation.view.elevation)
    after = step(state, jnp.array([0.5, 0.1 * inward]))
    observation = after.pipeline_state.observation
    assert after.info["is_reachable"] == 1.0
    turn = np.angle(np.exp(1j * float(observation.view.azimuth - before.observation.view.azimuth)))
    np.testing.assert_allclose(np.rad2deg(turn), 15.0, atol=1e-3)
    np.testing.assert_allclose(
        np.rad2deg(observation.view.elevation - before.observation.view.elevation), 3.0 * inward, atol=1e-3
    )
    similarity = cosine_similarity(observation.code, before.target.code)
    expected = CONFIG.env.success_reward if similarity >= CONFIG.env.threshold else similarity - 1.0
    np.testing.assert_allclose(after.reward, expected, atol=1e-6)


def test_unreachable_view_gives_reward_minus_two_and_the_arm_stays(env, reset, step):
    state, down = reset(jax.random.key(4)), jnp.array([0.0, -1.0])
    for _ in range(4):  # The height of the band is less than three steps.
        before, state = state, step(state, down)
        if state.info["is_reachable"] == 0.0:
            break
    assert state.info["is_reachable"] == 0.0
    assert state.reward == -2.0
    assert state.done == 0.0
    np.testing.assert_array_equal(state.obs, before.obs)
    assert state.pipeline_state.num_steps == before.pipeline_state.num_steps + 1


def test_an_action_of_nan_is_an_unreachable_step(reset, step):
    state = reset(jax.random.key(4))
    for action in ([jnp.nan, 0.0], [0.5, jnp.nan]):
        after = step(state, jnp.array(action))
        assert (after.reward, after.info["is_reachable"], after.metrics["unreachable"]) == (-2.0, 0.0, 1.0)
        np.testing.assert_array_equal(after.obs, state.obs)
        assert all(np.isfinite(np.asarray(x)).all() for x in jax.tree.leaves(after))


def test_a_step_after_the_end_earns_and_costs_nothing_and_the_arm_stays(env, reset, step):
    state = reset(jax.random.key(4))
    running = step(state, jnp.array([1.0, 0.0]))
    assert running.metrics["joint_travel"] > 0.0 and running.pipeline_state.num_steps == 1
    found = step(env.start(state.pipeline_state.observation, state.pipeline_state.observation), jnp.zeros(2))
    assert (found.reward, found.done) == (2.0, 1.0)
    after = step(found, jnp.array([1.0, 0.0]))
    assert (after.reward, after.done, after.info["terminated"]) == (0.0, 1.0, 1.0)
    assert (after.metrics["joint_travel"], after.metrics["motion_time"], after.metrics["unreachable"]) == (0, 0, 0)
    for part in ("pipeline_state", "obs", "info"):
        jax.tree.map(np.testing.assert_array_equal, getattr(after, part), getattr(found, part))


def test_reaching_the_threshold_terminates_with_reward_two(env, reset, step):
    state = reset(jax.random.key(5))
    at_target = env.start(state.pipeline_state.observation, state.pipeline_state.observation)
    after = step(at_target, jnp.zeros(2))
    assert (after.reward, after.done, after.info["terminated"], after.info["truncated"]) == (2.0, 1.0, 1.0, 0.0)
    errors = pose_error(after.pipeline_state.observation.camera, after.pipeline_state.target.camera)
    assert float(errors[0]) < np.deg2rad(2.0)
    assert float(errors[2]) < 5e-3


def test_last_step_sets_truncated_but_not_done(reset, step):
    state = reset(jax.random.key(6))
    # The zero code matches no view.
    episode = state.pipeline_state.replace(target=state.pipeline_state.target.replace(code=jnp.zeros(128)))
    state = state.replace(pipeline_state=episode)
    truncated = []
    for _ in range(CONFIG.env.episode_length):
        state = step(state, jnp.zeros(2))
        truncated.append(float(state.info["truncated"]))
        assert state.done == 0.0
    assert truncated == [0.0] * (CONFIG.env.episode_length - 1) + [1.0]


@pytest.mark.parametrize("name", ["jax_enable_x64", "jax_debug_nans"])
def test_a_setting_of_jax_with_which_the_task_does_not_run_is_named(name: str):
    jax.config.update(name, True)
    try:
        with pytest.raises(ConfigError, match=rf"{name.upper()} of JAX is on, but .*; switch it off: {name.upper()}=0"):
            vs.ViewSearchEnv(CONFIG)
    finally:
        jax.config.update(name, False)


@pytest.mark.slow
def test_repeated_actions_of_brax_pay_the_success_once(env, with_implicit_promotion):
    wrapped = jax.jit(EpisodeWrapper(env, episode_length=20, action_repeat=4).step)
    state = EpisodeWrapper(env, 20, 4).reset(jax.random.key(5))
    episode = state.pipeline_state
    at_target = state.replace(pipeline_state=episode.replace(target=episode.observation))
    assert wrapped(at_target, jnp.zeros(2)).reward == 2.0


@pytest.mark.slow
def test_environment_runs_under_the_wrappers_of_brax(env, with_implicit_promotion):
    # Silhouettes need no light, so there is less to compile.
    config = dataclasses.replace(CONFIG, encoder=dataclasses.replace(CONFIG.encoder, input="silhouette"))
    wrapped = wrap(vs.ViewSearchEnv(config, reach=env.reach), episode_length=3)
    state = jax.jit(wrapped.reset)(jax.random.split(jax.random.PRNGKey(0), 2))
    wrapped_step = jax.jit(wrapped.step)
    lengths = []
    for _ in range(6):
        state = wrapped_step(state, jnp.zeros((2, 2)))
        lengths.append(np.asarray(state.info["steps"]).tolist())
        assert np.isfinite(state.obs).all()
    assert max(max(length) for length in lengths) == 3
