"""Evaluation episodes of the policies."""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
from jax import Array

from vsearch_jax.config import Config
from vsearch_jax.env import ViewSearchEnv, episode_of
from vsearch_jax.evaluation.outcome import Outcome, measure_outcome
from vsearch_jax.evaluation.step_bound import steps_lower_bound
from vsearch_jax.search import SearchArgs, sac
from vsearch_jax.types import Observation, TrainState

if TYPE_CHECKING:
    from flax import nnx


def episode_keys(key: Array, config: Config) -> tuple[Array, Array]:
    """Splits a PRNG key into the keys of all evaluation episodes: E episodes for each of the run's S policies.

    Args:
      key: PRNG key of the policies' evaluation.
      config: gives the number of policies S (one for each policy seed) and of episodes E.

    Returns:
      Keys [S, E, 2] of each episode's initial view and target view, and keys [S, E] of each episode's search.
    """
    seeds = jax.vmap(functools.partial(jax.random.fold_in, key))(jnp.arange(config.sac.num_seeds))
    split = functools.partial(jax.random.split, num=config.evaluation.num_episodes)
    reset_keys, search_keys = jnp.moveaxis(jax.vmap(jax.vmap(jax.random.split))(jax.vmap(split)(seeds)), -1, 0)
    return jax.vmap(jax.vmap(jax.random.split))(reset_keys), search_keys


def evaluate_policies(
    env: ViewSearchEnv, state: TrainState, episodes: tuple[Array, Observation], grid: Observation
) -> Outcome:
    """Runs each of the S trained policies in its E evaluation episodes, and measures how each search ended.

    Args:
      env: the task.
      state: trained state that holds the S policies.
      episodes: PRNG key of each search, [S, E]; and what the camera sees from initial view and target view, [S, E, 2].
      grid: what the camera sees from a grid of views over the band (reachable elevations). It gives the lower bound on
        the steps.

    Returns:
      Measures by name, arrays [S, E]; `evaluate` describes them.
    """

    def run_episodes_of_policy(policy: tuple[nnx.State, tuple[Array, Observation]]) -> Outcome:
        actor, own_episodes = policy
        run = functools.partial(run_episode, env=env, actor=actor, grid=grid)
        return jax.lax.map(run, own_episodes, batch_size=env.config.evaluation.batch_size)

    return jax.lax.map(run_episodes_of_policy, (state.sac.actor, episodes))


def run_episode(
    episode: tuple[Array, Observation], *, env: ViewSearchEnv, actor: nnx.State, grid: Observation
) -> Outcome:
    """Runs one evaluation episode of a policy, and measures how the search ended: success, steps, pose errors.

    Args:
      episode: PRNG key of the search; and what the camera sees from initial view and target view, [2].
      env: the task.
      actor: parameters of the policy.
      grid: what the camera sees from a grid of views over the band (reachable elevations). It gives the lower bound on
        the steps.

    Returns:
      Measures of the episode by name; `evaluate` describes them.
    """
    search_key, observations = episode
    start = env.start(*(jax.tree.map(lambda x, i=i: x[i], observations) for i in range(2)))
    first = episode_of(start)
    args = SearchArgs(
        initial=first.observation.view,
        band=env.reach.band,
        threshold=jnp.asarray(env.config.env.threshold),
        task=sac.PolicyTask(actor, start),
    )
    result = sac.search(search_key, env.step, args, env.config)
    end = result.end
    assert end is not None  # the policy's search always sets it; only the black-box searchers leave it out
    last = episode_of(end.state)
    return measure_outcome(env.config, result, last.observation.camera, last.target.camera) | {
        "num_helped": end.num_helped,
        "joint_travel": end.travel,
        "motion_time": end.duration,
        "num_plans": result.evaluations,
        "initial_view": first.observation.view,
        "target_view": first.target.view,
        "steps_lower_bound": steps_lower_bound(first.observation.view, first.target, grid, env.reach.band, env.config),
    }
