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
from vsearch_jax.search import POLICIES, SearchArgs, sac
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
) -> dict[str, Outcome]:
    """Runs each of the S trained policies in its E evaluation episodes, and measures how each search ended.

    Each episode runs once for each kind of search by a policy: alone, and with a local search.

    Args:
      env: the task.
      state: trained state that holds the S policies.
      episodes: PRNG key of each search, [S, E]; and what the camera sees from initial view and target view, [S, E, 2].
      grid: what the camera sees from a grid of views over the band (reachable elevations). It gives the lower bound on
        the steps.

    Returns:
      For each key of `vsearch_jax.search.POLICIES` the measures by name, arrays [S, E]; `evaluate` describes them.
    """

    def run_episodes_of_policy(policy: tuple[nnx.State, tuple[Array, Observation]], is_assisted: Array) -> Outcome:
        actor, own_episodes = policy
        run = functools.partial(run_episode, env=env, actor=actor, grid=grid, is_assisted=is_assisted)
        return jax.lax.map(run, own_episodes, batch_size=env.config.evaluation.batch_size)

    def run_all(is_assisted: Array) -> Outcome:
        run = functools.partial(run_episodes_of_policy, is_assisted=is_assisted)
        return jax.lax.map(run, (state.sac.actor, episodes))

    # One loop over both kinds, so that the episode is compiled once.
    outcomes = jax.lax.map(run_all, jnp.asarray(list(POLICIES.values())))
    results = {name: jax.tree.map(lambda x, i=i: x[i], outcomes) for i, name in enumerate(POLICIES)}
    del results["sac"]["num_helped"]  # nothing helps the policy alone
    return results


def run_episode(
    episode: tuple[Array, Observation],
    *,
    env: ViewSearchEnv,
    actor: nnx.State,
    grid: Observation,
    is_assisted: Array,
) -> Outcome:
    """Runs one evaluation episode of a policy, and measures how the search ended: success, steps, pose errors.

    Args:
      episode: PRNG key of the search; and what the camera sees from initial view and target view, [2].
      env: the task.
      actor: parameters of the policy.
      grid: what the camera sees from a grid of views over the band (reachable elevations). It gives the lower bound on
        the steps.
      is_assisted: bool[], whether a local search helps the policy.

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
    result, num_helped = sac.assisted.search(search_key, env.step, args, env.config, is_assisted)
    end = result.end
    assert end is not None  # the policy's search always sets it; only the black-box searchers leave it out
    last = episode_of(end.state)
    return measure_outcome(env, result, last.observation.camera, last.target.camera) | {
        "num_helped": num_helped,
        "joint_travel": end.travel,
        "motion_time": end.duration,
        "num_plans": result.evaluations,
        "initial_view": first.observation.view,
        "target_view": first.target.view,
        "steps_lower_bound": steps_lower_bound(first.observation.view, first.target, grid, env.reach.band, env.config),
    }
