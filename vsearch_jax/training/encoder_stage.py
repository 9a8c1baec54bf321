"""Encoder stage of a run: updates on random views, then the pool of reachable views."""

from __future__ import annotations

import dataclasses
import functools

import jax
import jax.numpy as jnp
from jax import Array

from vsearch_jax import encoder as encoders
from vsearch_jax.env import (
    CLEAN,
    FALSE_POSITIVE_DEG,
    ViewSearchEnv,
    encoder_example,
    random_disturbances,
    random_example_views,
)
from vsearch_jax.training.metrics import ENCODER_STAGE, Metrics
from vsearch_jax.types import EncoderState, Observation

_CLEAN_INTERVAL = 10
"""One in this number of updates is on clean views. False matches are counted there, as a search would meet them."""
_CPU_BATCH_SIZE, _BATCH_SIZE = 64, 1024
"""Number of views of the pool that are rendered at a time: on CPU, and on accelerators."""


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
    view_key, disturbance_key, example_key = jax.random.split(jax.random.fold_in(key, i), 3)
    is_clean = i % _CLEAN_INTERVAL == 0
    views = random_example_views(view_key, env, is_clean)
    disturbances = jnp.where(is_clean, CLEAN, random_disturbances(disturbance_key, env.config.encoder))
    keys = jax.random.split(example_key, env.config.encoder.batch_size)
    inputs, targets, rotations = jax.vmap(functools.partial(encoder_example, env=env))(keys, views, disturbances)
    angles = encoders.view_angles(rotations, env.scene.symmetry)
    encoder, loss, latents = encoders.update(encoder, inputs, targets, angles, env.config)
    if env.config.encoder.loss == "autoencoder":  # its codes are latents without their mean
        latents = latents - jnp.mean(latents, axis=0, keepdims=True)
    # The views are new in every update, so before the update they are held out.
    matches = encoders.match_metrics(latents, angles, env.config, FALSE_POSITIVE_DEG)
    matches = {name: jnp.where(is_clean, value, jnp.nan) for name, value in matches.items()}
    return encoder, {"encoder_loss": loss, "stage": jnp.int32(ENCODER_STAGE)} | matches


def fill_pool(key: Array, env: ViewSearchEnv) -> tuple[EncoderState, Observation]:
    """Takes the images of the pool's views, and fits the whitening of the autoencoder's latents to them.

    Args:
      key: PRNG key of the views and of the arm's joint values.
      env: the task; its encoder has been trained.

    Returns:
      The encoder with its final mean and whitening; and the pool, an Observation of f32[P, ...] from P random reachable
      views. If the target of all episodes is fixed, the first is the target.
    """
    config, encoder = env.config, env.encoder
    keys = jax.random.split(key, config.encoder.pool_size)
    is_target = jnp.arange(config.encoder.pool_size) == 0
    batch_size = _CPU_BATCH_SIZE if jax.default_backend() == "cpu" else _BATCH_SIZE
    pool, raw = jax.lax.map(functools.partial(_raw_observation, env), (keys, is_target), batch_size=batch_size)
    if config.encoder.loss == "autoencoder":  # The pose loss is about the cosines of the raw latents.
        mean, whitening = encoders.fit_whitening(raw, config.encoder.whitening_power)
        encoder = dataclasses.replace(encoder, latent_mean=mean, whitening=whitening)
    return encoder, dataclasses.replace(pool, code=jax.vmap(functools.partial(encoders.code_of, encoder))(raw))


def _raw_observation(env: ViewSearchEnv, end: tuple[Array, Array]) -> tuple[Observation, Array]:
    """Returns an Observation with code 0 from a random view, and the raw latent f32[Z] of its image."""
    view, qpos = env.random_end(*end)
    camera, raw = env.observe_latent(qpos)
    return Observation(view=view, qpos=qpos, camera=camera, code=jnp.zeros_like(raw)), raw
