"""A whole run as one jitted function: encoder updates first, then policy iterations, in equal chunks.

A chunk is one loop for each stage. The loop bounds come from `state.step`, so all chunks of a config share one compiled
program. A run in chunks does the same operations in the same order as a run in one piece.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import TypeVar

import jax
import jax.numpy as jnp
from jax import Array

from vsearch_jax import encoder as encoders
from vsearch_jax.config import Config
from vsearch_jax.env import ViewSearchEnv, check_band, zero_observation
from vsearch_jax.search import sac
from vsearch_jax.training.encoder_stage import encoder_iteration, fill_pool
from vsearch_jax.training.metrics import ENCODER_METRICS, POLICY_METRICS, Metrics
from vsearch_jax.training.policy_stage import PolicyCarry, policy_iteration, start_from_pool, transition_of
from vsearch_jax.types import EncoderState, TrainState
from vsearch_jax.xla.tree import tree_zeros

Tree = TypeVar("Tree")

_ENCODER_INIT, _SAC_INIT, _ENCODER, _POOL, _RESTART, _POLICY = range(6)
"""Folded into the run's key, one for each purpose, so that no two purposes share random numbers."""


@functools.partial(jax.jit, static_argnames="config")
def init(key: Array, config: Config) -> TrainState:
    """Computes the state at the start of a run: reachability map of the arm, untrained encoder and untrained policies.

    Args:
      key: PRNG key; all random numbers of the run come from it.
      config: the run's config.

    Raises:
      SceneError: arm or object cannot be loaded.
      PlanningError: the motion is dynamic and a joint has no speed limit.
    """
    env = ViewSearchEnv(config, encoders.init(jax.random.fold_in(key, _ENCODER_INIT), config))
    observation = zero_observation(config.encoder.code_size, env.scene.mj_model.nq)
    pool = tree_zeros(observation, (config.encoder.pool_size,))
    start = jax.eval_shape(env.start, observation, observation)
    num_seeds, num_envs = config.sac.num_seeds, config.sac.num_envs
    transition = jax.eval_shape(transition_of, start, jax.ShapeDtypeStruct((env.action_size,), jnp.float32), start)
    seed_keys = jax.random.split(jax.random.fold_in(key, _SAC_INIT), num_seeds)
    init_sac = functools.partial(
        sac.init,
        config=config.sac,
        observation_size=env.observation_size,
        action_size=env.action_size,
        code_size=config.encoder.code_size,
    )
    replay = sac.init_replay(tree_zeros(transition, ()), config.sac.num_environment_steps)
    return TrainState(
        encoder=env.encoder,
        reach=env.reach,
        pool=pool,
        sac=jax.vmap(init_sac)(seed_keys),
        env=tree_zeros(start, (num_seeds, num_envs)),
        replay=tree_zeros(replay, (num_seeds,)),
        key=key,
        step=jnp.zeros((), jnp.int32),
    )


def train(state: TrainState, config: Config) -> tuple[TrainState, Metrics]:
    """Trains for one chunk: a fixed number of iterations, `config.chunk_length`. Call it until the run is done.

    With `num_chunks=1` one call is the whole run. After the end of the run a call changes nothing.

    Args:
      state: from `init` or an earlier call. It is donated, so it cannot be used again.
      config: the run's config. The function is traced once for each config.

    Returns:
      The new state, and metrics by name: f32[n], one entry for each of the n = `config.chunk_length` iterations.
      `stage` i32[n] is 0 for encoder iterations, 1 for policy iterations and -1 after the end of the run.
      A metric is NaN in iterations of the other stage. Metrics of the policies are means over the policy seeds.

    Raises:
      UnreachableError: there is no elevation that the arm reaches at every azimuth.
    """
    check_band(state.reach, config)
    return _train(state, config=config)


@functools.partial(jax.jit, static_argnames="config")
def with_encoder(state: TrainState, encoder: EncoderState, config: Config) -> TrainState:
    """Returns the state of a run whose encoder stage is done, with an encoder from another run.

    Args:
      state: state at the start of a run, from `init`.
      encoder: trained encoder; its network is that of `config.encoder`. The object may be another one.
      config: the run's config.
    """
    state = _finish_encoder(jnp.int32(0), dataclasses.replace(state, encoder=encoder), config=config)
    return dataclasses.replace(state, step=jnp.int32(config.encoder.num_updates))


@functools.partial(jax.jit, static_argnames="config", donate_argnames="state")
def _train(state: TrainState, config: Config) -> tuple[TrainState, Metrics]:
    """Runs one chunk; see `train`."""
    num_updates, length = config.encoder.num_updates, config.chunk_length
    start = state.step
    stop = jnp.minimum(start + length, config.num_iterations)
    encoder_stop = jnp.clip(num_updates, start, stop)
    metrics = {name: jnp.full((length,), jnp.nan) for name in (*ENCODER_METRICS, *POLICY_METRICS)}
    metrics["stage"] = jnp.full((length,), -1, jnp.int32)

    env = ViewSearchEnv(config, state.encoder, state.reach)
    update_encoder = functools.partial(encoder_iteration, env=env, key=jax.random.fold_in(state.key, _ENCODER))
    encoder, metrics = jax.lax.fori_loop(
        start, encoder_stop, functools.partial(_record_iteration, update_encoder, start), (state.encoder, metrics)
    )
    state = dataclasses.replace(state, encoder=encoder)

    # A loop of at most one iteration, not a conditional: XLA on CPU runs the body of a loop on all cores.
    is_encoder_done = ((start < num_updates) & (stop >= num_updates)).astype(jnp.int32)
    state = jax.lax.fori_loop(0, is_encoder_done, functools.partial(_finish_encoder, config=config), state)

    env = ViewSearchEnv(config, state.encoder, state.reach)
    pool = sac.index_pool(state.pool, state.reach)
    update_policy = functools.partial(policy_iteration, env=env, pool=pool, key=jax.random.fold_in(state.key, _POLICY))
    carry, metrics = jax.lax.fori_loop(
        encoder_stop,
        stop,
        functools.partial(_record_iteration, update_policy, start),
        (PolicyCarry(state.sac, state.env, state.replay), metrics),
    )
    return dataclasses.replace(state, sac=carry.sac, env=carry.env, replay=carry.replay, step=stop), metrics


def _record_iteration(
    iteration: Callable[[Array, Tree], tuple[Tree, Metrics]], start: Array, i: Array, carry: tuple[Tree, Metrics]
) -> tuple[Tree, Metrics]:
    """Runs iteration `i` of the run and writes its metrics to row `i - start` of the chunk's metrics."""
    state, metrics = carry
    state, new = iteration(i, state)
    return state, metrics | {name: metrics[name].at[i - start].set(value) for name, value in new.items()}


def _finish_encoder(index: Array, state: TrainState, *, config: Config) -> TrainState:
    """Ends the encoder stage: fills the pool, and starts the training environments from it.

    `index` is the loop's index, always 0. The keys depend on it, because XLA would move a body that does not depend on
    the loop out of the loop and run it in every chunk.
    """
    env = ViewSearchEnv(config, state.encoder, state.reach)
    encoder, pool = fill_pool(jax.random.fold_in(state.key, _POOL + index), env)
    shape = (config.sac.num_seeds, config.sac.num_envs)
    start = functools.partial(start_from_pool, env=env, pool=pool)
    states = jax.vmap(jax.vmap(start))(jax.random.split(jax.random.fold_in(state.key, _RESTART), shape))
    return dataclasses.replace(state, encoder=encoder, pool=pool, env=states)
