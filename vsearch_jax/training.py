"""The whole run as one jitted function: encoder updates, then policy iterations, cut into equal chunks.

A chunk is two loops whose bounds come from `state.step`, so every chunk of a config is the same compiled program, and
the operations and their order are those of an uncut run.
"""

from __future__ import annotations

import functools
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from vsearch_jax import encoder as encoders
from vsearch_jax import render
from vsearch_jax.config import Config
from vsearch_jax.env import ViewSearchEnv, check_band
from vsearch_jax.search import sac
from vsearch_jax.types import Observation, TrainState, Transition
from vsearch_jax.xla.tree import tree_where

ENCODER_STAGE, POLICY_STAGE = 0, 1
POLICY_METRICS = (
    "reward",
    "similarity",
    "success_rate",
    "unreachable_rate",
    "critic_loss",
    "actor_loss",
    "alpha",
    "entropy",
)
# Salts of the run's key, one for each use, so that no two uses share random numbers.
_ENCODER_INIT, _SAC_INIT, _ENCODER, _POOL, _RESTART, _POLICY = range(6)
_POOL_BATCH = 64


@functools.partial(jax.jit, static_argnames="config")
def init(key: Array, config: Config) -> TrainState:
    """Returns the state at the start of a run; computes the arm's reachability map on the way.

    Args:
      key: PRNG key from which all random numbers of the run come.
      config: the run's config.

    Raises:
      SceneError: arm or object can't be loaded.
    """
    env = ViewSearchEnv(config, encoders.init(jax.random.fold_in(key, _ENCODER_INIT), config))
    observation = jax.eval_shape(env.random_observation, key)
    pool = _zeros(observation, (config.encoder.pool_size,))
    start = jax.eval_shape(env.start, observation, observation)
    num_seeds, num_envs = config.sac.num_seeds, config.sac.num_envs
    transition = jax.eval_shape(transition_of, start, jax.ShapeDtypeStruct((env.action_size,), jnp.float32), start)
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
        replay=jax.tree.map(lambda x: jnp.zeros((num_seeds, *x.shape), x.dtype), replay),
        key=key,
        step=jnp.zeros((), jnp.int32),
    )


def train(state: TrainState, config: Config) -> tuple[TrainState, dict[str, Array]]:
    """Does one chunk of the run; with `num_chunks=1` the whole of it. After the last chunk it changes nothing.

    Args:
      state: from `init` or an earlier call; donated, so it can't be used again.
      config: the run's config; the function is traced once for each.

    Returns:
      The new state, and metrics by name, f32[n] with one entry for each of the chunk's iterations, n =
      `config.chunk_length`; `stage` i32[n] tells encoder (0) and policy (1) iterations, -1 stands past the end of the
      run. A metric is NaN where its stage was not run, the policy's are means over seeds.

    Raises:
      ConfigError: the arm reaches no elevation at every azimuth.
    """
    check_band(state.reach, config)
    return _train(state, config=config)


@functools.partial(jax.jit, static_argnames="config", donate_argnames="state")
def _train(state: TrainState, config: Config) -> tuple[TrainState, dict[str, Array]]:
    num_updates, length = config.encoder.num_updates, config.chunk_length
    start = state.step
    stop = jnp.minimum(start + length, config.num_iterations)
    encoder_stop = jnp.clip(num_updates, start, stop)
    metrics = {name: jnp.full((length,), jnp.nan) for name in ("encoder_loss", *POLICY_METRICS)}
    metrics["stage"] = jnp.full((length,), -1, jnp.int32)

    env = ViewSearchEnv(config, state.encoder, state.reach)
    update_encoder = functools.partial(encoder_iteration, env=env, key=jax.random.fold_in(state.key, _ENCODER))
    encoder, metrics = jax.lax.fori_loop(
        start, encoder_stop, functools.partial(_recorded, update_encoder, start), (state.encoder, metrics)
    )
    state = state.replace(encoder=encoder)  # pyright: ignore[reportAttributeAccessIssue] # flax adds it

    # A loop of one iteration or none: unlike a conditional, XLA on CPU runs its body on all cores.
    is_encoder_done = ((start < num_updates) & (stop >= num_updates)).astype(jnp.int32)
    state = jax.lax.fori_loop(0, is_encoder_done, functools.partial(finish_encoder, config=config), state)

    env = ViewSearchEnv(config, state.encoder, state.reach)
    update_policy = functools.partial(
        policy_iteration, env=env, pool=state.pool, key=jax.random.fold_in(state.key, _POLICY)
    )
    (sac_state, env_state, replay), metrics = jax.lax.fori_loop(
        encoder_stop,
        stop,
        functools.partial(_recorded, update_policy, start),
        ((state.sac, state.env, state.replay), metrics),
    )
    state = state.replace(sac=sac_state, env=env_state, replay=replay, step=stop)  # pyright: ignore[reportAttributeAccessIssue] # flax adds it
    return state, metrics


def _recorded(iteration: Any, start: Array, i: Array, carry: tuple[Any, dict[str, Array]]) -> Any:
    """Runs `iteration` number `i` of the run and writes its metrics to the chunk's row `i - start`."""
    state, metrics = carry
    state, new = iteration(i, state)
    return state, metrics | {name: metrics[name].at[i - start].set(value) for name, value in new.items()}


# -- encoder --------------------------------------------------------------------------------------------------------


def encoder_iteration(i: Array, encoder: Any, *, env: ViewSearchEnv, key: Array) -> tuple[Any, dict[str, Array]]:
    """Renders a batch of random views, augmented and clean, and does encoder update `i`."""
    keys = jax.random.split(jax.random.fold_in(key, i), env.config.encoder.batch_size)
    inputs, targets = jax.vmap(functools.partial(training_example, env=env))(keys)
    encoder, loss = encoders.update(encoder, inputs, targets, env.config)
    return encoder, {"encoder_loss": loss, "stage": jnp.int32(ENCODER_STAGE)}


def training_example(key: Array, *, env: ViewSearchEnv) -> tuple[Array, Array]:
    """Returns a random view as the encoder's augmented input f32[H, W, C] and as the clean target f32[h, w, C].

    The arm stands in a random configuration, so that its shadow is one more thing to ignore: the target has no shadows.
    """
    pose_key, light_key, camera_key, picture_key = jax.random.split(key, 4)
    _, qpos = env.random_pose(pose_key)
    data, camera = env.forward(qpos)
    object_ids = jnp.asarray(env.scene.object_geom_ids)

    size, decoder_size = env.config.scene.image_size, env.config.encoder.decoder_size
    lit_scene = encoders.randomize_lights(light_key, env.render_scene, env.center)
    image = render.render(lit_scene, data, encoders.jitter_camera(camera_key, camera), (size, size))
    pixels = encoders.network_input(image, object_ids, env.config)
    inputs = encoders.augment_input(
        picture_key, pixels, render.silhouette(image, env.scene.object_geom_ids), env.config
    )

    clean_scene = env.render_scene.replace(has_shadows=False)  # pyright: ignore[reportAttributeAccessIssue] # flax adds it
    clean = render.render(clean_scene, data, camera, (decoder_size, decoder_size))
    pixels = encoders.network_input(clean, object_ids, env.config)
    targets = encoders.clean_target(pixels, render.silhouette(clean, env.scene.object_geom_ids), env.config)
    return inputs, targets


def finish_encoder(index: Array, state: TrainState, *, config: Config) -> TrainState:
    """Fills the pool with random views, fits the whitening on them and starts the training environments from them."""
    env = ViewSearchEnv(config, state.encoder, state.reach)
    # `index` is 0. Without it nothing here would change from one iteration to the next, and XLA would move all of it
    # out of the loop, to be done in each chunk.
    keys = jax.random.split(jax.random.fold_in(state.key, _POOL + index), config.encoder.pool_size)
    pool, raw = jax.lax.map(functools.partial(_raw_observation, env), keys, batch_size=_POOL_BATCH)
    mean, whitening = encoders.fit_whitening(raw, config.encoder.whitening_power)
    encoder = state.encoder.replace(latent_mean=mean, whitening=whitening)  # pyright: ignore[reportAttributeAccessIssue] # flax adds it
    pool = pool.replace(code=jax.vmap(functools.partial(encoders.code_of, encoder))(raw))
    shape = (config.sac.num_seeds, config.sac.num_envs)
    start = functools.partial(pool_start, env=env, pool=pool)
    states = jax.vmap(jax.vmap(start))(jax.random.split(jax.random.fold_in(state.key, _RESTART), shape))
    return state.replace(encoder=encoder, pool=pool, env=states)  # pyright: ignore[reportAttributeAccessIssue] # flax adds it


def _raw_observation(env: ViewSearchEnv, key: Array) -> tuple[Observation, Array]:
    """Returns a random observation, its code still to be filled in, and the raw latent f32[Z] of its picture."""
    view, qpos = env.random_pose(key)
    camera, raw = env.observe_latent(qpos)
    return Observation(view=view, qpos=qpos, camera=camera, code=jnp.zeros_like(raw)), raw


# -- policy ---------------------------------------------------------------------------------------------------------


def policy_iteration(
    i: Array, carry: tuple[Any, Any, Any], *, env: ViewSearchEnv, pool: Observation, key: Array
) -> tuple[tuple[Any, Any, Any], dict[str, Array]]:
    """Does policy iteration `i` (of the run) for every seed: each environment steps once, then come the updates."""
    number = i - env.config.encoder.num_updates
    num_seeds = env.config.sac.num_seeds
    keys = jax.random.split(jax.random.fold_in(key, number), num_seeds)
    one_seed = functools.partial(_policy_iteration, number, env=env, pool=pool)
    carry, metrics = jax.vmap(one_seed)(carry, keys)
    means = {name: jnp.nanmean(metrics[name]) for name in POLICY_METRICS}
    return carry, means | {"stage": jnp.int32(POLICY_STAGE)}


def _policy_iteration(
    number: Array, carry: tuple[Any, Any, Any], key: Array, *, env: ViewSearchEnv, pool: Observation
) -> tuple[tuple[Any, Any, Any], dict[str, Array]]:
    sac_state, states, replay = carry
    config = env.config.sac
    is_warm = number * config.num_envs >= config.num_warmup_steps
    act_key, uniform_key, restart_key, update_key = jax.random.split(key, 4)
    shape = (config.num_envs, env.action_size)
    actions = sac.act(act_key, sac_state.actor, states.obs, config)
    actions = jnp.where(is_warm, actions, jax.random.uniform(uniform_key, shape, minval=-1.0, maxval=1.0))
    ends = jax.vmap(env.step)(states, actions)
    replay = sac.insert(replay, jax.vmap(transition_of)(states, actions, ends))
    restart = functools.partial(restart_ended, env=env, pool=pool)
    states = jax.vmap(restart)(jax.random.split(restart_key, config.num_envs), ends)

    num_updates = jnp.where(is_warm, int(config.updates_per_step * config.num_envs), 0)
    losses = {name: jnp.full((), jnp.nan) for name in ("critic_loss", "actor_loss", "alpha", "entropy")}
    one_update = functools.partial(_policy_update, key=update_key, replay=replay, pool=pool, config=env.config)
    sac_state, losses = jax.lax.fori_loop(0, num_updates, one_update, (sac_state, losses))

    terminated, truncated = ends.info["terminated"], ends.info["truncated"]
    metrics = {
        "reward": ends.reward.mean(),
        "similarity": ends.metrics["similarity"].mean(),
        "success_rate": terminated.sum() / (terminated + truncated).sum(),  # NaN where no episode ended
        "unreachable_rate": ends.metrics["unreachable"].mean(),
    }
    return (sac_state, states, replay), metrics | losses


def _policy_update(
    i: Array, carry: tuple[Any, Any], *, key: Array, replay: Any, pool: Observation, config: Config
) -> Any:
    sample_key, relabel_key, update_key = jax.random.split(jax.random.fold_in(key, i), 3)
    transitions = sac.sample_batch(sample_key, replay, config.sac.batch_size)
    transitions = sac.relabel(relabel_key, transitions, pool.code, config.env, config.sac)
    return sac.update(update_key, carry[0], transitions, config.sac)


def transition_of(state: Any, action: Array, next_state: Any) -> Transition:
    """Returns the transition from brax State `state` by `action` (f32[2]) to `next_state`, before any restart."""
    return Transition(
        obs=state.obs,
        action=action,
        reward=next_state.reward,
        next_obs=next_state.obs,
        terminated=next_state.info["terminated"],
        is_reachable=next_state.info["is_reachable"],
    )


def pool_start(key: Array, *, env: ViewSearchEnv, pool: Observation) -> Any:
    """Returns the start of an episode whose initial view and target are random entries of `pool`: it costs no image."""
    indices = jax.random.randint(key, (2,), 0, pool.qpos.shape[0])
    initial, target = (jax.tree.map(lambda x, n=n: x[indices[n]], pool) for n in range(2))
    return env.start(initial, target)


def restart_ended(key: Array, state: Any, *, env: ViewSearchEnv, pool: Observation) -> Any:
    """Returns `state`, or the start of a new episode where it terminated or was truncated."""
    is_ended = (state.info["terminated"] + state.info["truncated"]) > 0
    return tree_where(is_ended, pool_start(key, env=env, pool=pool), state)


def _zeros(tree: Any, leading: tuple[int, ...]) -> Any:
    """Returns zeros of the shapes and dtypes of `tree`, with `leading` axes put before each."""
    return jax.tree.map(lambda x: jnp.zeros((*leading, *x.shape), x.dtype), tree)
