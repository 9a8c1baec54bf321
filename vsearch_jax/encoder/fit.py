"""Training of the encoder: optimizer, loss of the decoder, pose loss; mean and partial whitening of the latent."""

from __future__ import annotations

import dataclasses
from typing import cast

import jax
import jax.numpy as jnp
import optax
import optax.contrib
from jax import Array

from vsearch_jax.config import Config
from vsearch_jax.encoder import network
from vsearch_jax.encoder.pose_loss import pose_loss
from vsearch_jax.types import EncoderState, ParamTree

_NUM_BISECTIONS = 16
"""The threshold is then exact to the largest error / 65,536, and the loss to the square of that."""
_EIGENVALUE_FLOOR = 1e-2
"""Smallest relative eigenvalue. Smaller eigenvalues are mostly noise: shadows of the other arm links, light."""
_ADAM_RMS = 0.2
"""Root mean square of the entries of Muon's steps in units of the step size. Adam's is about 0.2 (arXiv 2502.16982)."""


def init(key: Array, config: Config) -> EncoderState:
    """Returns an untrained encoder with random parameters, and a decoder if the loss needs one.

    Latent mean is zero, and whitening is the identity.

    Args:
      key: PRNG key of the parameters.
      config: the run's config.
    """
    params = network.init_params(key, config)
    size = config.encoder.code_size
    return EncoderState(params, optimizer(config).init(params), jnp.zeros(size), jnp.eye(size))


def optimizer(config: Config) -> optax.GradientTransformation:
    """Returns the encoder's optimizer, `encoder.optimizer`. Its step size falls to zero as a cosine over the updates.

    `muon` makes the steps of kernels and matrices orthogonal, and scales them to the size of Adam's (Jordan et al.
    2024, https://kellerjordan.github.io/posts/muon; Liu et al. 2025, arXiv 2502.16982). Biases keep Adam.

    Args:
      config: the run's config; its encoder part is read.
    """
    step_size = optax.cosine_decay_schedule(config.encoder.learning_rate, config.encoder.num_updates)
    if config.encoder.optimizer == "adam":
        return optax.adam(step_size)
    return optax.contrib.muon(
        step_size,
        adam_learning_rate=step_size,
        muon_weight_dimension_numbers=_matrix_axes,
        consistent_rms=_ADAM_RMS,
    )


def _matrix_axes(params: optax.Params) -> optax.Params:
    """Returns for each parameter which axes Muon takes as a matrix's rows and columns, or None for a bias."""

    def axes(x: Array) -> optax.contrib.MuonDimensionNumbers | None:
        last = x.ndim - 1
        return optax.contrib.MuonDimensionNumbers(tuple(range(last)), last) if last > 0 else None

    return jax.tree.map(axes, params)


def bootstrapped_mean(errors: Array, fraction: float) -> Array:
    """Computes the mean of the largest errors: those that make up the given fraction of all N errors.

    This mean is the minimum over t of t + mean(max(errors - t, 0)) / fraction, the conditional value at risk
    (Rockafellar and Uryasev 2000). Bisection finds t. It is 15 times faster than `top_k` on CPU. The gradient ignores
    t, because the derivative with respect to t is zero at the minimum.

    Args:
      errors: f32[N], none negative.
      fraction: part of the errors to average, in (0, 1].

    Returns:
      Mean of the largest `fraction` of the errors, f32[].
    """
    fixed = jax.lax.stop_gradient(errors)
    low, high = jnp.zeros(()), jnp.max(fixed)
    for _ in range(_NUM_BISECTIONS):
        middle = 0.5 * (low + high)
        is_low = jnp.mean(fixed > middle) > fraction
        low, high = jnp.where(is_low, middle, low), jnp.where(is_low, high, middle)
    threshold = 0.5 * (low + high)
    return threshold + jnp.mean(jnp.maximum(errors - threshold, 0.0)) / fraction


def reconstruction_loss(params: ParamTree, latent: Array, target: Array, config: Config) -> Array:
    """Computes the autoencoder's loss on one view: the mean of the largest squared errors of the decoded image.

    Args:
      params: parameters of encoder and decoder.
      latent: f32[Z], raw latent of the augmented view.
      target: f32[h, w, C], clean image that the decoder must reproduce; h and w are `decoder_size`.
      config: the run's config.

    Returns:
      Loss, f32[].
    """
    errors = jnp.mean((network.reconstruct(params, latent, config) - target) ** 2, axis=-1)
    return bootstrapped_mean(errors.reshape(-1), config.encoder.bootstrap_fraction)


def update(
    encoder: EncoderState, inputs: Array, targets: Array | None, angles: Array, config: Config
) -> tuple[EncoderState, Array, Array]:
    """Trains encoder, and decoder if there is one, by one step of the optimizer on a batch of B views.

    Args:
      encoder: state before the step. Latent mean and whitening do not change.
      inputs: f32[B, H, W, C], augmented input images with C channels.
      targets: f32[B, h, w, C], clean images of the same views; h and w are `decoder_size`. None for the pose loss.
      angles: f32[B, B] rad, angles between the views.
      config: the run's config; `encoder.loss` chooses the loss.

    Returns:
      The state after the step; the loss f32[] of the batch before the step; the raw latents f32[B, Z] before the step.
    """

    def batch_loss(params: ParamTree) -> tuple[Array, Array]:
        latents = jax.vmap(network.raw_latent, in_axes=(None, 0, None))(params, inputs, config)
        loss = jnp.zeros(())
        if targets is not None:
            rebuild = jax.vmap(reconstruction_loss, in_axes=(None, 0, 0, None))
            loss += jnp.mean(rebuild(params, latents, targets, config))
        if config.encoder.loss != "autoencoder":
            loss += pose_loss(latents, angles, config)
        return loss, latents

    (loss, latents), gradients = jax.value_and_grad(batch_loss, has_aux=True)(encoder.params)
    with jax.numpy_dtype_promotion("standard"):  # optax raises a float to the power of its integer step count
        updates, opt_state = optimizer(config).update(gradients, encoder.opt_state, encoder.params)
    # optax keeps the structure of the parameters, but its type is any tree.
    params = cast(ParamTree, optax.apply_updates(encoder.params, updates))
    return dataclasses.replace(encoder, params=params, opt_state=opt_state), loss, latents


def fit_whitening(raw: Array, power: float) -> tuple[Array, Array]:
    """Computes mean and partial whitening of raw latents (encoder outputs), which turn a raw latent into a code.

    The whitening matrix is symmetric. It has the eigenvectors of the covariance, and the eigenvalues of the covariance
    to the power -`power`. Eigenvalues below 1e-2 of the largest count as 1e-2 of it, so that noise is not amplified.
    The overall scale does not change a cosine; the scale here keeps the largest variance as it is.

    Args:
      raw: f32[N, Z], raw latents of N random reachable views, Z numbers each.
      power: 0 gives the identity, 1/2 gives unit variance in every direction.

    Returns:
      Mean f32[Z] and whitening f32[Z, Z]. The whitening is the identity if all latents are equal.
    """
    mean = jnp.mean(raw, axis=0)
    centred = raw - mean[None]
    eigenvalues, vectors = jnp.linalg.eigh(centred.T @ centred / raw.shape[0])
    largest = jnp.maximum(eigenvalues[-1], 1e-30)
    relative = jnp.clip(eigenvalues / largest, _EIGENVALUE_FLOOR, 1.0)
    relative = jnp.where(eigenvalues[-1] > 1e-30, relative, 1.0)
    return mean, (vectors * relative[None] ** (-power)) @ vectors.T
