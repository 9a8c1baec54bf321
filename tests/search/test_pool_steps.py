"""Tests of the steps between views of the pool."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vsearch_jax as vs
from vsearch_jax.search import sac
from vsearch_jax.types import Camera, Observation, ReachabilityMap, View

CONFIG = vs.Config.preset("smoke").env
BAND = np.deg2rad([40.0, 70.0]).astype(np.float32)
NUM_VIEWS, NUM_STEPS = 400, 300


def make_pool() -> tuple[Observation, np.ndarray]:
    """Returns a pool whose codes and joints tell the view's index, and the views f32[P, 2] in degrees."""
    rng = np.random.default_rng(0)
    degrees = np.stack([rng.uniform(-180.0, 180.0, NUM_VIEWS), rng.uniform(40.0, 70.0, NUM_VIEWS)], axis=-1)
    azimuth, elevation = np.deg2rad(degrees.T).astype(np.float32)
    code = rng.normal(size=(NUM_VIEWS, 16)).astype(np.float32)
    qpos = np.arange(NUM_VIEWS, dtype=np.float32)[:, None]
    zeros = jnp.zeros((NUM_VIEWS, 3))
    camera = Camera(zeros, jnp.zeros((NUM_VIEWS, 3, 3)), jnp.zeros(NUM_VIEWS))
    return Observation(View(jnp.asarray(azimuth), jnp.asarray(elevation)), qpos, camera, jnp.asarray(code)), degrees


def make_map() -> ReachabilityMap:
    """Returns a map of elevations from 20 to 90 degrees, of which 40 to 70 are reachable."""
    azimuths, elevations = np.arange(0.0, 360.0, 10.0), np.arange(20.0, 91.0, 5.0)
    is_reachable = np.broadcast_to((elevations >= 40.0) & (elevations <= 70.0), (len(azimuths), len(elevations)))
    axes = (jnp.asarray(np.deg2rad(axis), jnp.float32) for axis in (azimuths, elevations))
    return ReachabilityMap(*axes, jnp.asarray(is_reachable), jnp.zeros((*is_reachable.shape, 1)), jnp.asarray(BAND))


@pytest.fixture(scope="module")
def steps():
    pool, degrees = make_pool()
    indexed = sac.index_pool(pool, make_map())
    made, _ = sac.sample_pool_steps(jax.random.key(3), indexed, NUM_STEPS, CONFIG)
    return jax.tree.map(np.asarray, made), np.asarray(pool.code), degrees


def change_deg(degrees: np.ndarray, start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Returns the change f64[N, 2] of azimuth and elevation between views by their indices, the short way round."""
    change = degrees[end] - degrees[start]
    change[:, 0] = (change[:, 0] + 180.0) % 360.0 - 180.0
    return change


def test_the_action_leads_from_the_first_view_to_the_second(steps):
    made, code, degrees = steps
    start, end = made.obs[:, -1].astype(int), made.next_obs[:, -1].astype(int)
    np.testing.assert_array_equal(made.obs[:, :16], code[start])
    np.testing.assert_array_equal(made.next_obs[:, :16], code[end])
    is_reachable = made.is_reachable > 0.5
    np.testing.assert_array_equal(start[~is_reachable], end[~is_reachable])
    start, end, action = start[is_reachable], end[is_reachable], made.action[is_reachable]
    change = change_deg(degrees, start, end)
    wanted = np.clip(change / CONFIG.action_scale_deg, -1.0, 1.0)
    np.testing.assert_allclose(action, wanted, atol=1e-4)
    # The pool is sparse, so the nearest view can be some degrees beyond the longest step.
    assert (np.abs(change) <= CONFIG.action_scale_deg + 8.0).all()
    assert np.abs(action).mean() == pytest.approx(0.5, abs=0.1)


def test_steps_beyond_what_the_arm_reaches_stay_and_cost_the_penalty(steps):
    made, _, degrees = steps
    stays = made.is_reachable < 0.5
    assert 0.05 < stays.mean() < 0.33
    elevation = degrees[made.obs[stays, -1].astype(int), 1] + CONFIG.action_scale_deg * made.action[stays, 1]
    assert ((elevation < 40.0) | (elevation > 70.0)).all()
    np.testing.assert_array_equal(made.reward[stays], CONFIG.unreachable_reward)
    assert not made.terminated[stays].any()


def test_rewards_are_those_of_the_task(steps):
    made, _, _ = steps
    code, target = made.next_obs[:, :16], made.obs[:, 16:32]
    np.testing.assert_array_equal(target, made.next_obs[:, 16:32])
    cosine = (code * target).sum(-1) / np.linalg.norm(code, axis=-1) / np.linalg.norm(target, axis=-1)
    is_reachable = made.is_reachable > 0.5
    is_found = cosine[is_reachable] >= CONFIG.threshold
    np.testing.assert_array_equal(made.terminated[is_reachable], is_found)
    reward = np.where(is_found, CONFIG.success_reward, cosine[is_reachable] - 1.0)
    np.testing.assert_allclose(made.reward[is_reachable], reward, atol=1e-5)


def test_a_third_of_the_targets_is_the_end_of_the_step_and_a_third_is_near_it(steps):
    made, code, degrees = steps
    end = made.next_obs[:, -1].astype(int)
    target = np.argmin(np.linalg.norm(code[None] - made.obs[:, None, 16:32], axis=-1), axis=-1)
    distance = np.linalg.norm(change_deg(degrees, end, target), axis=-1)
    assert (target == end).mean() == pytest.approx(1 / 3, abs=0.15)  # a near target can be the end too
    assert (distance < 20.0).mean() == pytest.approx(0.7, abs=0.1)


def test_known_actions_lead_to_every_target_within_one_step_and_only_to_those():
    pool, degrees = make_pool()
    _, known = sac.sample_pool_steps(jax.random.key(3), sac.index_pool(pool, make_map()), NUM_STEPS, CONFIG)
    obs, action, is_known = (np.asarray(x) for x in known)
    start = obs[:, -1].astype(int)
    target = np.argmin(np.linalg.norm(np.asarray(pool.code)[None] - obs[:, None, 16:32], axis=-1), axis=-1)
    change = change_deg(degrees, start, target)
    # The action ends one degree inside the band.
    change[:, 1] = np.clip(degrees[target, 1], 41.0, 69.0) - degrees[start, 1]
    assert (np.abs(degrees[target, 1] - 55.0) > 14.0).any()
    np.testing.assert_array_equal(is_known, np.abs(change).max(axis=-1) <= CONFIG.action_scale_deg)
    assert 0.5 < is_known.mean() < 0.9
    np.testing.assert_allclose(action * CONFIG.action_scale_deg, change, atol=2e-3)
