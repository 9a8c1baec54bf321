"""Autoencoder: layers against XLA's convolution, loss against a sort, whitening, augmentation, training."""

from __future__ import annotations

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vsearch_jax import encoder as encoders
from vsearch_jax.config import PRESETS, Config, ConfigError, EncoderConfig
from vsearch_jax.encoder import fit, network
from vsearch_jax.encoder.convolution import convolution_by_matmul, convolution_by_xla, convolve
from vsearch_jax.types import Image

INPUTS = ("rgb", "depth", "silhouette")
BOOTSTRAPPED = jax.jit(jax.value_and_grad(fit.bootstrapped_mean), static_argnums=1)


def smoke_config(**encoder):
    """Returns the smoke preset with changed fields of EncoderConfig."""
    smoke = PRESETS["smoke"]
    return dataclasses.replace(smoke, encoder=dataclasses.replace(smoke.encoder, **encoder))


# -- layers ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("convolution", [convolution_by_matmul, convolve])
@pytest.mark.parametrize(("kernel_size", "stride"), [(3, 2), (5, 2), (8, 4)])
def test_our_convolutions_and_their_gradients_equal_xla(convolution, kernel_size, stride):
    x_key, kernel_key, weight_key = jax.random.split(jax.random.key(kernel_size), 3)
    x = jax.random.normal(x_key, (2, 16, 24, 3))
    kernel = jax.random.normal(kernel_key, (kernel_size, kernel_size, 3, 5))
    weights = jax.random.normal(weight_key, (2, 16 // stride, 24 // stride, 5))

    def total(convolution, x, kernel):
        return jnp.sum(weights * jax.vmap(convolution, in_axes=(0, None, None))(x, kernel, stride))

    for argument in (0, 1):
        ours, xla = (
            jax.jit(jax.grad(functools.partial(total, function), argnums=argument))(x, kernel)
            for function in (convolution, convolution_by_xla)
        )
        np.testing.assert_allclose(ours, xla, rtol=1e-4, atol=1e-3)
    ours, xla = (function(x[0], kernel, stride) for function in (convolution, convolution_by_xla))
    assert ours.shape == (16 // stride, 24 // stride, 5)
    np.testing.assert_allclose(ours, xla, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize("kind", INPUTS)
def test_code_and_reconstruction_have_the_configured_shape_for_every_preset_and_input(preset, kind):
    config = Config.preset(preset)
    config = dataclasses.replace(config, encoder=dataclasses.replace(config.encoder, input=kind, loss="both"))
    features, size = 3 if kind == "rgb" else 1, config.scene.image_size
    state = jax.eval_shape(lambda: encoders.init(jax.random.key(0), config))
    x = jax.ShapeDtypeStruct((size, size, features), jnp.float32)
    code = jax.eval_shape(functools.partial(encoders.encode, config=config), state, x)
    reconstruction = jax.eval_shape(functools.partial(encoders.reconstruct, config=config), state.params, code)
    assert code.shape == (128,)
    assert reconstruction.shape == (config.encoder.decoder_size, config.encoder.decoder_size, features)


def test_parameters_are_nested_dictionaries_of_arrays_and_depend_on_the_key():
    config = smoke_config(loss="both")
    first, again, other = (encoders.init(jax.random.key(seed), config).params for seed in (0, 0, 1))
    assert set(first) == {"encoder", "decoder"}
    assert all(isinstance(leaf, jax.Array) for leaf in jax.tree.leaves(first))
    assert all(np.array_equal(a, b) for a, b in zip(jax.tree.leaves(first), jax.tree.leaves(again), strict=True))
    assert not np.array_equal(first["encoder"]["dense"]["kernel"], other["encoder"]["dense"]["kernel"])


def test_image_size_that_the_strides_do_not_divide_raises_an_error():
    with pytest.raises(ConfigError, match=r"SceneConfig.image_size is 128; allowed: a multiple of 256"):
        Config(encoder=EncoderConfig(channels=(8,) * 7, decoder_size=128))


# -- code -----------------------------------------------------------------------------------------------------------


def test_code_has_mean_square_one_at_every_scale_and_is_finite_at_zero():
    state = encoders.init(jax.random.key(0), smoke_config())
    raw = jax.random.normal(jax.random.key(1), (128,))
    code = encoders.code_of(state, raw)
    np.testing.assert_allclose(jnp.mean(code**2), 1.0, rtol=1e-5)
    np.testing.assert_allclose(encoders.code_of(state, 7.0 * raw), code, rtol=1e-4)
    assert np.all(encoders.code_of(state, jnp.zeros(128)) == 0.0)
    assert np.all(np.isfinite(jax.jacobian(functools.partial(encoders.code_of, state))(jnp.zeros(128))))


def test_network_input_follows_the_config():
    depth = jnp.array([[jnp.inf, 0.35], [0.175, 0.525]])
    image = Image(rgb=jnp.full((2, 2, 3), 0.3), depth=depth, geom_id=jnp.array([[-1, 4], [2, 7]]))
    rgb, depth, silhouette = (encoders.network_input(image, (4, 7), smoke_config(input=kind)) for kind in INPUTS)
    np.testing.assert_array_equal(rgb, image.rgb)
    np.testing.assert_allclose(depth[..., 0], [[1.0, 0.5], [0.0, 1.0]], atol=1e-6)
    np.testing.assert_array_equal(silhouette[..., 0], [[0.0, 1.0], [0.0, 1.0]])


@pytest.mark.parametrize(("intensity", "kind"), [("log", "rgb"), ("linear", "rgb"), ("log", "depth")])
def test_a_shadow_is_an_offset_only_of_the_logarithm_of_rgb(intensity, kind):
    config = smoke_config(intensity=intensity, input=kind)
    params = encoders.init(jax.random.key(0), config).params
    kernel = params["encoder"]["convolutions"][0]["kernel"]
    if kind == "rgb":  # filters that ignore an offset common to red, green and blue
        params["encoder"]["convolutions"][0]["kernel"] = kernel - kernel.mean(axis=2, keepdims=True)
    x = jax.random.uniform(jax.random.key(1), (32, 32, kernel.shape[2]), minval=0.4)
    latents = [encoders.raw_latent(params, image, config) for image in (x, 0.5 * x)]
    change = jnp.linalg.norm(latents[1] - latents[0]) / jnp.linalg.norm(latents[0])
    if kind == "rgb" and intensity == "log":
        assert change < 0.15
    else:
        np.testing.assert_allclose(change, 0.5, atol=0.02)  # with biases of 0, layers are linear in a positive factor


# -- loss and whitening ---------------------------------------------------------------------------------------------


@given(st.integers(0, 1000), st.sampled_from([1.0, 0.5, 0.25, 0.1]), st.sampled_from([1.0, 1e-4, 1e3]))
def test_bootstrapped_mean_equals_the_mean_of_the_largest_errors(seed, fraction, scale):
    errors = np.float32(scale * np.random.default_rng(seed).exponential(size=200))
    largest = np.sort(errors)[-round(fraction * 200) :]
    value, gradient = BOOTSTRAPPED(errors, fraction)
    np.testing.assert_allclose(value, largest.mean(), rtol=1e-4)
    # Bisection may misplace one error that is nearly equal to the threshold.
    is_largest = errors >= largest[0]
    assert np.sum((gradient > 0) != is_largest) <= 1
    np.testing.assert_allclose(gradient[gradient > 0], 1.0 / (fraction * 200), rtol=1e-5)


def test_bootstrapped_mean_of_equal_errors_is_their_value():
    np.testing.assert_allclose(fit.bootstrapped_mean(jnp.full(16, 0.25), 0.25), 0.25, rtol=1e-4)
    assert fit.bootstrapped_mean(jnp.zeros(16), 0.25) == 0.0


def test_whitening_is_symmetric_and_ranges_from_the_identity_to_unit_covariance():
    mix = jax.random.normal(jax.random.key(0), (6, 6))
    raw = 3.0 + jax.random.normal(jax.random.key(1), (500, 6)) @ mix
    mean, identity = fit.fit_whitening(raw, 0.0)
    np.testing.assert_allclose(mean, np.mean(raw, axis=0), atol=1e-5)
    np.testing.assert_allclose(identity, np.eye(6), atol=1e-5)
    _, quarter = fit.fit_whitening(raw, 0.25)
    _, half = fit.fit_whitening(raw, 0.5)
    np.testing.assert_allclose(half, half.T, atol=1e-4)
    np.testing.assert_allclose(quarter @ quarter, half, rtol=1e-3, atol=1e-3)
    covariance = np.cov((np.asarray(raw) @ np.asarray(half)).T)
    np.testing.assert_allclose(covariance / covariance[0, 0], np.eye(6), atol=5e-3)


def test_whitening_bounds_small_eigenvalues_and_is_the_identity_for_a_constant_latent():
    scales = jnp.array([1.0, 1e-6])
    raw = jax.random.normal(jax.random.key(0), (500, 2)) * scales[None]
    _, whitening = fit.fit_whitening(raw, 0.5)
    assert np.linalg.eigvalsh(whitening).max() < 10.1
    mean, whitening = fit.fit_whitening(jnp.ones((8, 3)), 0.5)
    np.testing.assert_array_equal(mean, np.ones(3))
    np.testing.assert_allclose(whitening, np.eye(3), atol=1e-6)


# -- training -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("kind", "loss", "optimizer"),
    [
        *((kind, "autoencoder", "adam") for kind in INPUTS),
        ("rgb", "pose", "adam"),
        ("rgb", "pose", "muon"),
        ("rgb", "both", "muon"),
    ],
)
def test_updates_reduce_the_loss_and_change_nothing_after_num_updates(kind, loss, optimizer):
    config = smoke_config(input=kind, loss=loss, optimizer=optimizer, num_updates=150, learning_rate=3e-3)
    shape = (8, 32, 32, network.in_features(config.encoder))
    inputs = jax.random.uniform(jax.random.key(1), shape)
    targets = None if loss == "pose" else jax.image.resize(inputs, (8, 16, 16, shape[-1]), "linear")
    angles = 0.4 * jnp.abs(jnp.arange(8.0)[:, None] - jnp.arange(8.0)[None])

    def update(state):
        return encoders.update(state, inputs, targets, angles, config)[:2]

    def body(_, carry):
        return update(carry[0])

    start = encoders.init(jax.random.key(0), config)
    _, first = update(start)
    end, last = jax.jit(lambda state: jax.lax.fori_loop(0, 150, body, (state, 0.0)))(start)
    assert float(last) < 0.35 * float(first)
    after, _ = update(end)
    for a, b in zip(jax.tree.leaves(end.params), jax.tree.leaves(after.params), strict=True):
        np.testing.assert_array_equal(a, b)
    counts = [x for path, x in jax.tree.leaves_with_path(end.opt_state) if "count" in jax.tree_util.keystr(path)]
    assert set(np.asarray(counts)) == {150}


def test_a_step_of_muon_is_orthogonal_and_of_the_size_of_adams():
    config = smoke_config(optimizer="muon", learning_rate=1e-3)
    before = encoders.init(jax.random.key(0), config)
    inputs = jax.random.uniform(jax.random.key(1), (8, 32, 32, 3))
    angles = 0.4 * jnp.abs(jnp.arange(8.0)[:, None] - jnp.arange(8.0)[None])
    after = encoders.update(before, inputs, None, angles, config)[0]
    steps = [b - a for a, b in zip(jax.tree.leaves(before.params), jax.tree.leaves(after.params), strict=True)]
    matrices = [np.asarray(x).reshape(-1, x.shape[-1]) for x in steps if x.ndim > 1]
    assert len(matrices) == len(config.encoder.channels) + len(config.encoder.hidden_sizes) + 1
    for matrix in matrices:
        singular = np.linalg.svd(matrix, compute_uv=False)
        expected = 0.2e-3 * np.sqrt(max(matrix.shape))  # an orthogonal matrix whose entries have this root mean square
        rank = np.sum(singular > 0.3 * expected)
        assert rank >= 6  # of a gradient of 8 images
        assert singular.max() < 1.3 * expected
        assert np.median(singular[:rank]) > 0.6 * expected
