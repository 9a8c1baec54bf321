"""Policy stage of a run: environment steps, replay and updates of soft actor-critic, for all seeds side by side."""

from __future__ import annotations

import functools
import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
from brax.envs.base import State
from jax import Array

from vsearch_jax.env import FALSE_POSITIVE_DEG, ViewSearchEnv, episode_of, obs_of, pose_error
from vsearch_jax.search import sac
from vsearch_jax.training.metrics import POLICY_METRICS, POLICY_STAGE, UPDATE_METRICS, Metrics
from vsearch_jax.types import Observation, ReplayState, SACState, Transition
from vsearch_jax.xla.tree import tree_where


class PolicyCarry(NamedTuple):
    """What a policy iteration changes, of one seed or with a leading axis of seeds.

    Attributes:
      sac: SACState.
      env: brax State of the training environments, leading axis num_envs.
      replay: ReplayState.
    """

    sac: SACState
    env: State
    replay: ReplayState


def policy_iteration(
    i: Array, carry: PolicyCarry, *, env: ViewSearchEnv, pool: sac.IndexedPool, key: Array
) -> tuple[PolicyCarry, Metrics]:
    """Does one iteration for every seed: one step of each environment, then the updates.

    Args:
      i: i32[], number of the iteration in the run.
      carry: states of all seeds.
      env: the task, with the trained encoder.
      pool: the pool of reachable views.
      key: PRNG key of the policy stage, equal for all iterations.

    Returns:
      The states after the iteration; and its metrics by name, f32[] each, means over the seeds.
    """
    number = i - env.config.encoder.num_updates
    num_seeds = env.config.sac.num_seeds
    keys = jax.random.split(jax.random.fold_in(key, number), num_seeds)
    one_seed = functools.partial(_policy_iteration_of_seed, number, env=env, pool=pool)
    carry, metrics = jax.vmap(one_seed)(carry, keys)
    means = {name: jnp.nanmean(metrics[name]) for name in POLICY_METRICS}
    return carry, means | {"stage": jnp.int32(POLICY_STAGE)}


def _policy_iteration_of_seed(
    number: Array, carry: PolicyCarry, key: Array, *, env: ViewSearchEnv, pool: sac.IndexedPool
) -> tuple[PolicyCarry, Metrics]:
    """Does policy iteration `number` for one seed. Without updates, during warm-up, the update metrics are NaN."""
    sac_state, states, replay = carry
    config = env.config.sac
    is_warm = number * config.num_envs >= config.num_warmup_steps
    act_key, uniform_key, restart_key, update_key = jax.random.split(key, 4)
    shape = (config.num_envs, env.action_size)
    actions = sac.act(act_key, sac_state.actor, obs_of(states), config)
    actions = jnp.where(is_warm, actions, jax.random.uniform(uniform_key, shape, minval=-1.0, maxval=1.0))
    ends = jax.vmap(env.step)(states, actions)
    replay = sac.insert(replay, jax.vmap(transition_of)(states, actions, ends))
    restart = functools.partial(_restart_ended, env=env, pool=pool)
    states = jax.vmap(restart)(jax.random.split(restart_key, config.num_envs), ends)

    num_updates = jnp.where(is_warm, int(config.updates_per_step * config.num_envs), 0)
    no_update = {name: jnp.full((), jnp.nan) for name in UPDATE_METRICS}
    one_update = functools.partial(_policy_update, key=update_key, replay=replay, env=env, pool=pool)
    sac_state, update_metrics = jax.lax.fori_loop(0, num_updates, one_update, (sac_state, no_update))
    return PolicyCarry(sac_state, states, replay), _step_metrics(env, ends) | update_metrics


def _step_metrics(env: ViewSearchEnv, ends: State) -> Metrics:
    """Returns metrics f32[] over the environments (leading axis) after a step."""
    terminated, truncated = ends.info["terminated"], ends.info["truncated"]
    episode = episode_of(ends)
    rotation, _, _ = pose_error(episode.observation.camera, episode.target.camera, env.scene.symmetry, env.center)
    is_right = (rotation <= math.radians(FALSE_POSITIVE_DEG)).astype(terminated.dtype)
    return {
        "reward": ends.reward.mean(),
        "similarity": ends.metrics["similarity"].mean(),
        "success_rate": terminated.sum() / (terminated + truncated).sum(),  # NaN if no episode ended
        "pose_success_rate": (terminated * is_right).sum() / (terminated + truncated).sum(),
        "unreachable_rate": ends.metrics["unreachable"].mean(),
    }


def _policy_update(
    i: Array,
    carry: tuple[SACState, Metrics],
    *,
    key: Array,
    replay: ReplayState,
    env: ViewSearchEnv,
    pool: sac.IndexedPool,
) -> tuple[SACState, Metrics]:
    """Does SAC update `i` of an iteration, on relabelled steps of the replay buffer and on steps between pool views."""
    config = env.config
    sample_key, pool_key, relabel_key, update_key = jax.random.split(jax.random.fold_in(key, i), 4)
    num_pool_steps = round(config.sac.pool_fraction * config.sac.batch_size)
    transitions = sac.sample_batch(sample_key, replay, config.sac.batch_size - num_pool_steps)
    transitions = sac.relabel(relabel_key, transitions, pool.observations.code, config.env, config.sac)
    known = None
    if num_pool_steps > 0:
        made, known = sac.sample_pool_steps(pool_key, pool, num_pool_steps, config.env)
        transitions = jax.tree.map(lambda *x: jnp.concatenate(x), transitions, made)
    return sac.update(update_key, carry[0], transitions, config.sac, known if config.sac.imitation_weight > 0 else None)


def transition_of(state: State, action: Array, next_state: State) -> Transition:
    """Returns one step of an episode as a Transition for the replay buffer.

    Args:
      state: brax State before the step.
      action: f32[2], the action.
      next_state: brax State after the step, before any restart.
    """
    return Transition(
        obs=obs_of(state),
        action=action,
        reward=next_state.reward,
        next_obs=obs_of(next_state),
        terminated=next_state.info["terminated"],
        is_reachable=next_state.info["is_reachable"],
    )


def start_from_pool(key: Array, *, env: ViewSearchEnv, pool: Observation) -> State:
    """Starts an episode from the pool: returns its brax State. No image is needed.

    Args:
      key: PRNG key.
      env: the task.
      pool: Observation of f32[P, ...] from P reachable views. Initial view and target are random entries. A fixed
        target is the first entry.
    """
    indices = jax.random.randint(key, (2,), 0, pool.qpos.shape[0])
    if env.config.env.target == "fixed":
        indices = indices.at[1].set(0)
    initial, target = (jax.tree.map(lambda x, n=n: x[indices[n]], pool) for n in range(2))
    return env.start(initial, target)


def _restart_ended(key: Array, state: State, *, env: ViewSearchEnv, pool: sac.IndexedPool) -> State:
    """Returns `state`, or the start of a new episode if its episode terminated or was truncated."""
    is_ended = (state.info["terminated"] + state.info["truncated"]) > 0
    return tree_where(is_ended, start_from_pool(key, env=env, pool=pool.observations), state)
