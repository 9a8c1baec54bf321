"""Searches by a policy, alone and with a local search.

The policies are not trained. Each one moves straight to a fixed view, its aim.
"""

import dataclasses
import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax.envs.base import State
from flax import nnx

import probes
from vsearch_jax.config import Config
from vsearch_jax.env import episode_of
from vsearch_jax.geometry import wrap_angle
from vsearch_jax.search import SearchArgs, sac
from vsearch_jax.search.sac import policy
from vsearch_jax.types import Camera, EpisodeState, Observation, View
from vsearch_jax.xla.tree import tree_where

CONFIG = Config()
SCALE = math.radians(CONFIG.env.action_scale_deg)
TARGET = View(jnp.float32(0.3), jnp.float32(math.radians(55.0)))
NUM_EPISODES = 64


def initial_state(view: View, aim: View) -> State:
    """Returns the start of an episode. Its obs is the action towards `aim`, and `qpos` holds the aim."""
    camera = Camera(position=jnp.zeros(3), rotation=jnp.eye(3), fovy=jnp.ones(()))
    observation = Observation(view=view, qpos=jnp.stack([aim.azimuth, aim.elevation]), camera=camera, code=jnp.zeros(1))
    episode = EpisodeState(observation=observation, target=observation, num_steps=jnp.int32(0))
    info, zero = {"is_reachable": jnp.ones(())}, jnp.zeros(())
    obs = action_towards(view, observation.qpos)
    return State(probes.as_pipeline_state(episode), obs, zero, zero, metrics_at(view), info)


def action_towards(view: View, aim: jax.Array) -> jax.Array:
    change = jnp.stack([wrap_angle(aim[0] - view.azimuth), aim[1] - view.elevation])
    return jnp.clip(change / SCALE, -1.0, 1.0)


def metrics_at(view: View) -> dict[str, jax.Array]:
    return {"similarity": similarity(view), "joint_travel": jnp.float32(0.5), "motion_time": jnp.float32(2.0)}


def similarity(view: View) -> jax.Array:
    """Returns the score: 0.98 at 3 degrees from the target, as with a trained encoder, and nearly constant far away."""
    azimuth, elevation = wrap_angle(view.azimuth - TARGET.azimuth), view.elevation - TARGET.elevation
    return jnp.exp(-0.0202 * (azimuth**2 + elevation**2) / math.radians(3.0) ** 2)


def step(state: State, action: jax.Array) -> State:
    episode = episode_of(state)
    old = episode.observation.view
    view = View(wrap_angle(old.azimuth + SCALE * action[0]), old.elevation + SCALE * action[1])
    is_reachable = (view.elevation >= probes.BAND[0] - 1e-6) & (view.elevation <= probes.BAND[1] + 1e-6)
    view = tree_where(is_reachable, view, old)
    observation = dataclasses.replace(episode.observation, view=view)
    episode = dataclasses.replace(episode, observation=observation, num_steps=episode.num_steps + 1)
    info = {"is_reachable": is_reachable.astype(jnp.float32)}
    obs = action_towards(view, observation.qpos)
    pipeline_state = probes.as_pipeline_state(episode)
    return dataclasses.replace(state, pipeline_state=pipeline_state, obs=obs, metrics=metrics_at(view), info=info)


@pytest.fixture
def run_episodes(monkeypatch):
    """Returns a function that runs one episode for each of N initial views and aims, View of f32[N] rad each.

    It returns their SearchResult and the number of steps that the local search chose.
    """
    monkeypatch.setattr(policy, "act", lambda key, actor, obs, config: obs)

    def episode(key, view, aim, is_assisted):
        start = initial_state(view, aim)
        task = sac.PolicyTask(nnx.State({}), start)
        args = SearchArgs(view, jnp.array(probes.BAND), jnp.float32(CONFIG.env.threshold), task)
        if is_assisted is None:
            return sac.search(key, step, args, CONFIG), jnp.int32(0)
        return sac.assisted.search(key, step, args, CONFIG, is_assisted)

    def run(initial, aims, is_assisted=True):
        keys = jax.random.split(jax.random.key(0), NUM_EPISODES)
        episodes = jax.vmap(functools.partial(episode, is_assisted=is_assisted))
        return jax.jit(episodes)(keys, initial, aims)

    return run


def random_initial_views() -> View:
    return probes.random_views(jax.random.key(1), NUM_EPISODES)


def circle_around_target(degrees: float) -> View:
    """Returns one view for each episode, all `degrees` away from the target."""
    angle = jnp.linspace(0.0, 2.0 * jnp.pi, NUM_EPISODES, endpoint=False)
    offset = math.radians(degrees)
    return View(TARGET.azimuth + offset * jnp.cos(angle), TARGET.elevation + offset * jnp.sin(angle))


def repeated(view: View) -> View:
    """Returns the view once for each episode."""
    return jax.tree.map(lambda x: jnp.full(NUM_EPISODES, x), view)


def test_a_policy_that_finds_the_target_is_not_helped(run_episodes):
    result, num_helped = run_episodes(random_initial_views(), repeated(TARGET))
    assert (np.asarray(result.score) >= CONFIG.env.threshold).all()
    assert (np.asarray(num_helped) == 0).all()
    np.testing.assert_allclose(result.end.travel, 0.5 * np.asarray(result.evaluations))
    np.testing.assert_allclose(result.end.duration, 2.0 * np.asarray(result.evaluations))
    assert np.asarray(result.evaluations).max() <= 6


@pytest.mark.parametrize("degrees", [3.3, 4.5, 6.0])
def test_a_policy_that_stops_near_the_target_is_helped_to_it(run_episodes, degrees):
    result, num_helped = run_episodes(random_initial_views(), circle_around_target(degrees))
    assert (np.asarray(result.score) >= CONFIG.env.threshold).all()
    num_helped = np.asarray(num_helped)
    assert (num_helped > 0).mean() > 0.8  # the other policies pass the target on their way
    assert num_helped.mean() <= 5.0


def test_a_policy_that_stays_far_from_the_target_is_moved_around_the_object(run_episodes):
    far = View(TARGET.azimuth + jnp.linspace(1.5, 4.5, NUM_EPISODES), jnp.full(NUM_EPISODES, TARGET.elevation))
    result, num_helped = run_episodes(far, far)
    assert (np.asarray(num_helped) > 0).all()
    assert (np.asarray(result.best_scores[:, CONFIG.evaluation.patience - 1]) < 0.5).all()
    assert (np.asarray(result.best_scores[:, -1]) > 0.5).mean() > 0.9  # the arm came to the side of the target


def test_an_unreachable_step_is_not_repeated_forever(run_episodes):
    above = View(jnp.full(NUM_EPISODES, TARGET.azimuth), jnp.full(NUM_EPISODES, probes.BAND[1] + 1.0))
    top = View(random_initial_views().azimuth, jnp.full(NUM_EPISODES, probes.BAND[1]))
    result, _ = run_episodes(top, above)
    # Without help all 20 steps would be unreachable. With help at most every second step is.
    assert (2 * np.asarray(result.unreachable) <= np.asarray(result.evaluations) + 1).all()


def test_without_help_the_assisted_search_is_that_of_the_policy_alone(run_episodes):
    """Half of the policies find their target. The others stop 4.5 degrees away from it, and no help comes."""
    is_found = np.arange(NUM_EPISODES) % 2 == 0
    aims = jax.tree.map(lambda a, b: jnp.where(is_found, a, b), repeated(TARGET), circle_around_target(4.5))
    alone, _ = run_episodes(random_initial_views(), aims, is_assisted=None)
    unhelped, num_helped = run_episodes(random_initial_views(), aims, is_assisted=False)
    for ours, expected in zip(jax.tree.leaves(unhelped), jax.tree.leaves(alone), strict=True):
        np.testing.assert_array_equal(ours, expected)
    assert (np.asarray(num_helped) == 0).all()
    success = (np.asarray(alone.score) >= CONFIG.env.threshold)[~is_found].mean()
    assert success < 0.5, "the aims must be views that do not meet the threshold"
