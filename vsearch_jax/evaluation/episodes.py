"""Episodes of the policies."""

from __future__ import annotations

import functools
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from vsearch_jax.config import Config
from vsearch_jax.env import ViewSearchEnv, episode_of
from vsearch_jax.evaluation.outcome import measure_outcome
from vsearch_jax.evaluation.step_bound import steps_lower_bound
from vsearch_jax.search import SearchArgs, sac
from vsearch_jax.types import Observation, TrainState


def episode_keys(key: Array, config: Config) -> tuple[Array, Array]:
    """Returns keys [seeds, episodes, 2] of each episode's initial view and target, and keys [seeds, episodes] of it."""
    seeds = jax.vmap(functools.partial(jax.random.fold_in, key))(jnp.arange(config.sac.num_seeds))
    split = functools.partial(jax.random.split, num=config.evaluation.num_episodes)
    reset_keys, search_keys = jnp.moveaxis(jax.vmap(jax.vmap(jax.random.split))(jax.vmap(split)(seeds)), -1, 0)
    return jax.vmap(jax.vmap(jax.random.split))(reset_keys), search_keys


def evaluate_policies(
    env: ViewSearchEnv, state: TrainState, episodes: tuple[Array, Observation], grid: Observation
) -> dict[str, Any]:
    """Runs every policy in its `num_episodes` episodes; see `evaluate` for the result.

    Args:
      env: the task.
      state: holds the policies.
      episodes: keys [seeds, episodes] and Observation [seeds, episodes, 2] of initial view and target.
      grid: Observation of views over the band, for the bound.
    """

    def one_policy(xs: tuple[Any, tuple[Array, Observation]]) -> dict[str, Any]:
        actor, own = xs
        run = functools.partial(run_episode, env=env, actor=actor, grid=grid)
        return jax.lax.map(run, own, batch_size=env.config.evaluation.batch_size)

    return jax.lax.map(one_policy, (state.sac.actor, episodes))


def run_episode(
    episode: tuple[Array, Observation], *, env: ViewSearchEnv, actor: Any, grid: Observation
) -> dict[str, Any]:
    """Runs one episode of a policy and measures where it ended."""
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
    last = episode_of(result.end.state)
    return measure_outcome(env.config, result, last.observation.camera, last.target.camera) | {
        "num_helped": result.end.num_helped,
        "joint_travel": result.end.travel,
        "motion_time": result.end.duration,
        "num_plans": result.evaluations,
        "initial_view": first.observation.view,
        "target_view": first.target.view,
        "steps_lower_bound": steps_lower_bound(first.observation.view, first.target, grid, env.reach.band, env.config),
    }
