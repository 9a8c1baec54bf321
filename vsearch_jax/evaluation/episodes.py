"""Evaluation episodes of the policies.

Most episodes end after 3 or 4 steps, and a few take all steps. So the episodes run on a pool of lanes: a lane takes the
next episode as soon as its own ends.
"""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
from jax import Array

from vsearch_jax.config import Config
from vsearch_jax.env import ViewSearchEnv, episode_of
from vsearch_jax.evaluation.outcome import Outcome, measure_outcome
from vsearch_jax.evaluation.step_bound import steps_lower_bound
from vsearch_jax.evaluation.views import SeenView
from vsearch_jax.search import POLICIES, SearchArgs, sac
from vsearch_jax.search.common import is_running
from vsearch_jax.search.sac import assisted, policy
from vsearch_jax.types import Observation, TrainState
from vsearch_jax.xla import lane_pool
from vsearch_jax.xla.batching import map_in_batches
from vsearch_jax.xla.tree import tree_where, tree_zeros

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


class _Episode(NamedTuple):
    """An episode to run.

    Attributes:
      number: i32[], number of the policy.
      key: PRNG key of the local search.
      ends: Observation of f32[2, ...]: what the camera sees from initial view and target view.
    """

    number: Array
    key: Array
    ends: Observation


_Loop: TypeAlias = tuple[policy.Progress, assisted.Help]
_Ends: TypeAlias = tuple[Outcome, Array]


class _Bench(NamedTuple):
    """What all episodes share. It holds the task too, so it is no pytree.

    Attributes:
      env: the task.
      actors: parameters of the S policies, leading axis S.
      is_assisted: bool[], whether a local search helps the policies.
    """

    env: ViewSearchEnv
    actors: nnx.State
    is_assisted: Array


def evaluate_policies(
    env: ViewSearchEnv, state: TrainState, episodes: tuple[Array, Observation], grid: SeenView
) -> dict[str, Outcome]:
    """Runs each of the S trained policies in its E evaluation episodes, and measures how each search ended.

    Each episode runs once for each kind of search by a policy: alone, and with a local search. Until the policy stalls,
    both are the same search. So an episode in which the policy alone never stalls runs only once.

    Args:
      env: the task.
      state: trained state that holds the S policies.
      episodes: PRNG key of each search, [S, E]; and what the camera sees from initial view and target view, [S, E, 2].
      grid: what the camera sees from a grid of views over the band (reachable elevations). It gives the lower bound on
        the steps.

    Returns:
      For each key of `vsearch_jax.search.POLICIES` the measures by name, arrays [S, E]; `evaluate` describes them.
    """
    shape = episodes[0].shape
    numbers = jnp.broadcast_to(jnp.arange(shape[0])[:, None], shape)
    flat = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), _Episode(numbers, *episodes))
    num_lanes = min(env.config.evaluation.batch_size, flat.number.size)
    lanes = jax.vmap(functools.partial(_start_loop, _Bench(env, state.sac.actor, jnp.bool_(False))))(
        jax.tree.map(lambda x: x[:num_lanes], flat)
    )

    def run_all(before: _Ends, is_assisted: Array) -> tuple[_Ends, _Ends]:
        bench = _Bench(env, state.sac.actor, is_assisted)
        after = lane_pool.run(_job(bench), flat, lane_pool.queue_where(before[1] > 0), lanes, before)
        return after, after

    first = jax.tree.map(lambda x: x[0], (flat, lanes))
    unknown, _ = tree_zeros(jax.eval_shape(functools.partial(_measure, env), *first), flat.number.shape)
    # One loop over both kinds, so that the episode is compiled once. The policies alone come first, in all episodes.
    before = (unknown, jnp.ones(flat.number.shape, jnp.int32))
    _, (outcomes, num_stalled) = jax.lax.scan(run_all, before, jnp.asarray(list(POLICIES.values())))

    bound = map_in_batches(functools.partial(_lower_bound, env, grid), flat.ends, env.config.evaluation.batch_size)
    results: dict[str, Outcome] = {}
    for i, (name, is_assisted) in enumerate(POLICIES.items()):
        outcome: Outcome = jax.tree.map(lambda x, i=i: x[i], outcomes) | {"steps_lower_bound": bound}
        if is_assisted:
            outcome["num_helped"] = num_stalled[i]
        results[name] = jax.tree.map(lambda x: x.reshape(*shape, *x.shape[1:]), outcome)
    return results


def _job(bench: _Bench) -> lane_pool.Job[_Episode, _Loop, tuple[Outcome, Array]]:
    return lane_pool.Job(
        reset=lambda episode, loop, is_new: tree_where(is_new, _start_loop(bench, episode), loop),
        step=functools.partial(_step_loop, bench),
        is_done=functools.partial(_is_done, bench.env),
        result=functools.partial(_measure, bench.env),
        has_stragglers=False,  # to compile the renderer once more takes longer than the last steps on all lanes
    )


def _search_args(bench: _Bench, episode: _Episode) -> SearchArgs[sac.PolicyTask]:
    """Returns the search problem of an episode."""
    env = bench.env
    actor = jax.tree.map(lambda x: x[episode.number], bench.actors)
    start = env.start(*(jax.tree.map(lambda x, i=i: x[i], episode.ends) for i in range(2)))
    return SearchArgs(
        initial=episode_of(start).observation.view,
        band=env.reach.band,
        threshold=jnp.asarray(env.config.env.threshold),
        task=sac.PolicyTask(actor, start),
    )


def _start_loop(bench: _Bench, episode: _Episode) -> _Loop:
    return policy.start_progress(_search_args(bench, episode), bench.env.config), assisted.no_help()


def _step_loop(bench: _Bench, episode: _Episode, loop: _Loop) -> _Loop:
    """Runs one step of the episode. An episode that has ended does not change."""
    env, args = bench.env, _search_args(bench, episode)
    choose = functools.partial(assisted.choose_action, episode.key, args, env.config, bench.is_assisted)
    return tree_where(_is_done(env, loop), loop, policy.run_step(env.step, args, choose, loop))


def _is_done(env: ViewSearchEnv, loop: _Loop) -> Array:
    return ~is_running(loop[0].record, jnp.asarray(env.config.env.threshold))


def _measure(env: ViewSearchEnv, episode: _Episode, loop: _Loop) -> tuple[Outcome, Array]:
    """Returns the measures of an episode that has ended; and i32[], the number of steps before which it had stalled."""
    progress, help_ = loop
    result, last = policy.episode_result(progress), episode_of(progress.state)
    travel, duration = progress.costs
    outcome = measure_outcome(env, result, last.observation, last.target) | {
        "joint_travel": travel,
        "motion_time": duration,
        "num_plans": result.evaluations,
        "initial_view": jax.tree.map(lambda x: x[0], episode.ends.view),
    }
    return outcome, help_.num_stalled


def _lower_bound(env: ViewSearchEnv, grid: SeenView, ends: Observation) -> Array:
    """Returns the lower bound i32[] on the steps of an episode; `ends` is of its initial view and its target view."""
    initial, target = (jax.tree.map(lambda x, i=i: x[i], ends) for i in range(2))
    return steps_lower_bound(initial.view, target, grid, env.reach.band, env.config)
