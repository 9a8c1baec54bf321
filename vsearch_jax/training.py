"""A whole run as one jitted function: encoder updates first, then policy iterations, in equal chunks.

A chunk is one loop for each stage. The loop bounds come from `state.step`, so all chunks of a config share one compiled
program. A run in chunks does the same operations in the same order as a run in one piece.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import NamedTuple, TypeAlias, TypeVar

import jax
import jax.numpy as jnp
from brax.envs.base import State
from jax import Array

from vsearch_jax import encoder as encoders
from vsearch_jax.config import Config
from vsearch_jax.env import (
    FALSE_POSITIVE_DEG,
    ViewSearchEnv,
    check_band,
    encoder_example,
    obs_of,
    random_example_views,
    zero_observation,
)
from vsearch_jax.search import sac
from vsearch_jax.types import EncoderState, Observation, ReplayState, SACState, TrainState, Transition
from vsearch_jax.xla.tree import tree_where

Metrics: TypeAlias = dict[str, Array]
Tree = TypeVar("Tree")

ENCODER_STAGE, POLICY_STAGE = 0, 1
ENCODER_METRICS = ("encoder_loss", "false_match_rate", "threshold_angle_deg")
_UPDATE_METRICS = ("critic_loss", "actor_loss", "alpha", "entropy")
POLICY_METRICS = ("reward", "similarity", "success_rate", "unreachable_rate", *_UPDATE_METRICS)

_ENCODER_INIT, _SAC_INIT, _ENCODER, _POOL, _RESTART, _POLICY = range(6)
"""Folded into the run's key, one for each purpose, so that no two purposes share random numbers."""
_POOL_BATCH_SIZE, _CPU_POOL_BATCH_SIZE = 1024, 64
"""Number of views of the pool that are rendered at a time: on accelerators, and on CPU."""


class _PolicyCarry(NamedTuple):
    """What a policy iteration changes, of one seed or with a leading axis of seeds.

    Attributes:
      sac: SACState.
      env: brax State of the training environments, leading axis num_envs.
      replay: ReplayState.
    """

    sac: SACState
    env: State
    replay: ReplayState


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
    pool = _zeros(observation, (config.encoder.pool_size,))
    start = jax.eval_shape(env.start, observation, observation)
    num_seeds, num_envs = config.sac.num_seeds, config.sac.num_envs
    transition = jax.eval_shape(_transition_of, start, jax.ShapeDtypeStruct((env.action_size,), jnp.float32), start)
    seed_keys = jax.random.split(jax.random.fold_in(key, _SAC_INIT), num_seeds)
    init_sac = functools.partial(
        sac.init, config=config.sac, observation_size=env.observation_size, action_size=env.action_size
    )
    replay = sac.init_replay(_zeros(transition, ()), config.sac.num_environment_steps)
    return TrainState(
        encoder=env.encoder,
        reach=env.reach,
        pool=pool,
        sac=jax.vmap(init_sac)(seed_keys),
        env=_zeros(start, (num_seeds, num_envs)),
        replay=_zeros(replay, (num_seeds,)),
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
    update_policy = functools.partial(
        _policy_iteration, env=env, pool=state.pool, key=jax.random.fold_in(state.key, _POLICY)
    )
    carry, metrics = jax.lax.fori_loop(
        encoder_stop,
        stop,
        functools.partial(_record_iteration, update_policy, start),
        (_PolicyCarry(state.sac, state.env, state.replay), metrics),
    )
    return dataclasses.replace(state, sac=carry.sac, env=carry.env, replay=carry.replay, step=stop), metrics


def _record_iteration(
    iteration: Callable[[Array, Tree], tuple[Tree, Metrics]], start: Array, i: Array, carry: tuple[Tree, Metrics]
) -> tuple[Tree, Metrics]:
    """Runs iteration `i` of the run and writes its metrics to row `i - start` of the chunk's metrics."""
    state, metrics = carry
    state, new = iteration(i, state)
    return state, metrics | {name: metrics[name].at[i - start].set(value) for name, value in new.items()}


def encoder_iteration(
    i: Array, encoder: EncoderState, *, env: ViewSearchEnv, key: Array
) -> tuple[EncoderState, Metrics]:
    """Does one encoder update on a batch of random views.

    Args:
      i: i32[], number of the update.
      encoder: the encoder before the update.
      env: the task, which renders the views. The encoder in it is not used.
      key: PRNG key of the encoder stage, equal for all updates.

    Returns:
      The encoder after the update, and the metrics of the update by name, f32[] each.
    """
    view_key, example_key = jax.random.split(jax.random.fold_in(key, i))
    views = random_example_views(view_key, env)
    keys = jax.random.split(example_key, env.config.encoder.batch_size)
    inputs, targets, rotations = jax.vmap(functools.partial(encoder_example, env=env))(keys, views)
    angles = encoders.view_angles(rotations, env.scene.symmetry)
    encoder, loss, latents = encoders.update(encoder, inputs, targets, angles, env.config)
    if env.config.encoder.loss == "autoencoder":  # its codes are latents without their mean
        latents = latents - jnp.mean(latents, axis=0, keepdims=True)
    # The views are new in every update, so before the update they are held out.
    matches = encoders.match_metrics(latents, angles, env.config, FALSE_POSITIVE_DEG)
    return encoder, {"encoder_loss": loss, "stage": jnp.int32(ENCODER_STAGE)} | matches


def _finish_encoder(index: Array, state: TrainState, *, config: Config) -> TrainState:
    """Ends the encoder stage: fills the pool, fits the whitening on it, and starts the training environments from it.

    `index` is the loop's index, always 0. The keys depend on it, because XLA would move a body that does not depend on
    the loop out of the loop and run it in every chunk.
    """
    env = ViewSearchEnv(config, state.encoder, state.reach)
    keys = jax.random.split(jax.random.fold_in(state.key, _POOL + index), config.encoder.pool_size)
    batch_size = _CPU_POOL_BATCH_SIZE if jax.default_backend() == "cpu" else _POOL_BATCH_SIZE
    pool, raw = jax.lax.map(functools.partial(_raw_observation, env), keys, batch_size=batch_size)
    encoder = state.encoder
    if config.encoder.loss == "autoencoder":  # The pose loss is about the cosines of the raw latents.
        mean, whitening = encoders.fit_whitening(raw, config.encoder.whitening_power)
        encoder = dataclasses.replace(encoder, latent_mean=mean, whitening=whitening)
    pool = dataclasses.replace(pool, code=jax.vmap(functools.partial(encoders.code_of, encoder))(raw))
    shape = (config.sac.num_seeds, config.sac.num_envs)
    start = functools.partial(_start_from_pool, env=env, pool=pool)
    states = jax.vmap(jax.vmap(start))(jax.random.split(jax.random.fold_in(state.key, _RESTART), shape))
    return dataclasses.replace(state, encoder=encoder, pool=pool, env=states)


def _raw_observation(env: ViewSearchEnv, key: Array) -> tuple[Observation, Array]:
    """Returns a random Observation with code 0, and the raw latent f32[Z] of its image."""
    view, qpos = env.random_pose(key)
    camera, raw = env.observe_latent(qpos)
    return Observation(view=view, qpos=qpos, camera=camera, code=jnp.zeros_like(raw)), raw


def _policy_iteration(
    i: Array, carry: _PolicyCarry, *, env: ViewSearchEnv, pool: Observation, key: Array
) -> tuple[_PolicyCarry, Metrics]:
    """Does iteration `i` of the run for every seed: one step of each environment, then the updates."""
    number = i - env.config.encoder.num_updates
    num_seeds = env.config.sac.num_seeds
    keys = jax.random.split(jax.random.fold_in(key, number), num_seeds)
    one_seed = functools.partial(_policy_iteration_of_seed, number, env=env, pool=pool)
    carry, metrics = jax.vmap(one_seed)(carry, keys)
    means = {name: jnp.nanmean(metrics[name]) for name in POLICY_METRICS}
    return carry, means | {"stage": jnp.int32(POLICY_STAGE)}


def _policy_iteration_of_seed(
    number: Array, carry: _PolicyCarry, key: Array, *, env: ViewSearchEnv, pool: Observation
) -> tuple[_PolicyCarry, Metrics]:
    """Does policy iteration `number` for one seed. Without updates, during warm-up, the update metrics are NaN."""
    sac_state, states, replay = carry
    config = env.config.sac
    is_warm = number * config.num_envs >= config.num_warmup_steps
    act_key, uniform_key, restart_key, update_key = jax.random.split(key, 4)
    shape = (config.num_envs, env.action_size)
    actions = sac.act(act_key, sac_state.actor, obs_of(states), config)
    actions = jnp.where(is_warm, actions, jax.random.uniform(uniform_key, shape, minval=-1.0, maxval=1.0))
    ends = jax.vmap(env.step)(states, actions)
    replay = sac.insert(replay, jax.vmap(_transition_of)(states, actions, ends))
    restart = functools.partial(_restart_ended, env=env, pool=pool)
    states = jax.vmap(restart)(jax.random.split(restart_key, config.num_envs), ends)

    num_updates = jnp.where(is_warm, int(config.updates_per_step * config.num_envs), 0)
    no_update = {name: jnp.full((), jnp.nan) for name in _UPDATE_METRICS}
    one_update = functools.partial(_policy_update, key=update_key, replay=replay, pool=pool, config=env.config)
    sac_state, update_metrics = jax.lax.fori_loop(0, num_updates, one_update, (sac_state, no_update))
    return _PolicyCarry(sac_state, states, replay), _step_metrics(ends) | update_metrics


def _step_metrics(ends: State) -> Metrics:
    """Returns metrics f32[] over the environments (leading axis) after a step."""
    terminated, truncated = ends.info["terminated"], ends.info["truncated"]
    return {
        "reward": ends.reward.mean(),
        "similarity": ends.metrics["similarity"].mean(),
        "success_rate": terminated.sum() / (terminated + truncated).sum(),  # NaN if no episode ended
        "unreachable_rate": ends.metrics["unreachable"].mean(),
    }


def _policy_update(
    i: Array, carry: tuple[SACState, Metrics], *, key: Array, replay: ReplayState, pool: Observation, config: Config
) -> tuple[SACState, Metrics]:
    """Does SAC update `i` of an iteration on a relabelled batch of the replay buffer."""
    sample_key, relabel_key, update_key = jax.random.split(jax.random.fold_in(key, i), 3)
    transitions = sac.sample_batch(sample_key, replay, config.sac.batch_size)
    transitions = sac.relabel(relabel_key, transitions, pool.code, config.env, config.sac)
    return sac.update(update_key, carry[0], transitions, config.sac)


def _transition_of(state: State, action: Array, next_state: State) -> Transition:
    """Returns the Transition from `state` by `action` (f32[2]) to `next_state`, the state before any restart."""
    return Transition(
        obs=obs_of(state),
        action=action,
        reward=next_state.reward,
        next_obs=obs_of(next_state),
        terminated=next_state.info["terminated"],
        is_reachable=next_state.info["is_reachable"],
    )


def _start_from_pool(key: Array, *, env: ViewSearchEnv, pool: Observation) -> State:
    """Returns the start of an episode. Initial view and target are random entries of `pool`, so no image is needed."""
    indices = jax.random.randint(key, (2,), 0, pool.qpos.shape[0])
    initial, target = (jax.tree.map(lambda x, n=n: x[indices[n]], pool) for n in range(2))
    return env.start(initial, target)


def _restart_ended(key: Array, state: State, *, env: ViewSearchEnv, pool: Observation) -> State:
    """Returns `state`, or the start of a new episode if its episode terminated or was truncated."""
    is_ended = (state.info["terminated"] + state.info["truncated"]) > 0
    return tree_where(is_ended, _start_from_pool(key, env=env, pool=pool), state)


def _zeros(tree: Tree, leading: tuple[int, ...]) -> Tree:
    """Returns zeros with the shapes and dtypes of `tree`; the axes `leading` are added in front of each shape."""
    return jax.tree.map(lambda x: jnp.zeros((*leading, *x.shape), x.dtype), tree)
