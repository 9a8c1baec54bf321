"""The networks of the autoencoder.

The encoder maps an image to a latent by strided convolutions. The decoder maps a latent to an image by sub-pixel
upsampling. Both take one item; batch them with `jax.vmap`.
"""

from __future__ import annotations

import functools
import itertools
import math

import jax
import jax.numpy as jnp
from flax import nnx
from jax import Array

from vsearch_jax.config import Config, EncoderConfig
from vsearch_jax.encoder.convolution import convolve
from vsearch_jax.types import EncoderState, Image, ParamTree

_LOG_FLOOR, _LOG_OFFSET = 0.05, 2.2
"""Intensity that counts as almost black, and the logarithm's value at a mean intensity of 0.4."""


class StridedConvolution(nnx.Module):
    """A convolution with a stride, by the faster way on the present platform."""

    def __init__(self, in_features: int, out_features: int, kernel_size: int, stride: int, *, rngs: nnx.Rngs) -> None:
        """Draws the parameters.

        Args:
          in_features: number of input channels.
          out_features: number of output channels.
          kernel_size: k, height and width of the kernel in pixels.
          stride: s, in pixels.
          rngs: random numbers for the parameters.
        """
        shape = (kernel_size, kernel_size, in_features, out_features)
        self.kernel = nnx.Param(jax.nn.initializers.he_normal()(rngs.params(), shape))
        self.bias = nnx.Param(jnp.zeros(out_features))
        self.stride = stride

    def __call__(self, x: Array) -> Array:
        """Returns f32[H/s, W/s, K] from `x` f32[H, W, C]."""
        return convolve(x, self.kernel[...], self.stride) + self.bias[None, None]


class SubPixelUpsampling(nnx.Module):
    """Doubles height and width: a matmul maps each cell to the features of its four quarters (Shi et al. 2016)."""

    def __init__(self, in_features: int, out_features: int, *, rngs: nnx.Rngs) -> None:
        """Draws the parameters.

        Args:
          in_features: number of input channels.
          out_features: number of output channels.
          rngs: random numbers for the parameters.
        """
        self.linear = nnx.Linear(in_features, 4 * out_features, kernel_init=jax.nn.initializers.he_normal(), rngs=rngs)

    def __call__(self, x: Array) -> Array:
        """Returns f32[2H, 2W, K] from `x` f32[H, W, C]."""
        height, width, _ = x.shape
        x = self.linear(x).reshape(height, width, 2, 2, -1)
        return x.transpose(0, 2, 1, 3, 4).reshape(2 * height, 2 * width, -1)


def in_features(config: EncoderConfig) -> int:
    """Returns the number of channels of the encoder's input image: 3 for rgb, 1 for depth and silhouette."""
    return 3 if config.input == "rgb" else 1


class Encoder(nnx.Module):
    """Maps an image to its raw latent."""

    def __init__(self, config: EncoderConfig, image_size: int, *, rngs: nnx.Rngs) -> None:
        """Draws the parameters.

        Args:
          config: kind of input, channels, kernel size, strides, hidden sizes and code size.
          image_size: height and width of the image in pixels.
          rngs: random numbers for the parameters.
        """
        sizes = [2 * config.stem_stride if config.stem_stride > 2 else config.kernel_size]
        sizes += [config.kernel_size] * (len(config.channels) - 1)
        strides = [config.stem_stride] + [2] * (len(config.channels) - 1)
        inputs = (in_features(config), *config.channels[:-1])
        layers = zip(inputs, config.channels, sizes, strides, strict=True)
        self.convolutions = nnx.List([StridedConvolution(*layer, rngs=rngs) for layer in layers])
        cells = (image_size // math.prod(strides)) ** 2
        widths = (cells * config.channels[-1], *config.hidden_sizes)
        he_normal = jax.nn.initializers.he_normal()
        self.hidden = nnx.List(
            [nnx.Linear(a, b, kernel_init=he_normal, rngs=rngs) for a, b in itertools.pairwise(widths)]
        )
        self.dense = nnx.Linear(widths[-1], config.code_size, rngs=rngs)
        self.is_log = config.input == "rgb" and config.intensity == "log"

    def __call__(self, x: Array) -> Array:
        """Returns the raw latent f32[Z] of `x`, f32[H, W, C] in [0, 1]."""
        if self.is_log:
            x = jnp.log1p(x / _LOG_FLOOR) - _LOG_OFFSET
        for convolution in self.convolutions:
            x = jax.nn.relu(convolution(x))
        x = x.reshape(-1)
        for hidden in self.hidden:
            x = jax.nn.relu(hidden(x))
        return self.dense(x)


class Decoder(nnx.Module):
    """Maps a raw latent to the clean image."""

    def __init__(self, config: EncoderConfig, *, rngs: nnx.Rngs) -> None:
        """Draws the parameters.

        Args:
          config: kind of input, channels, code size and decoder size.
          rngs: random numbers for the parameters.
        """
        self.shape = (config.decoder_size // 2 ** len(config.channels),) * 2 + (config.channels[-1],)
        self.dense = nnx.Linear(
            config.code_size, math.prod(self.shape), kernel_init=jax.nn.initializers.he_normal(), rngs=rngs
        )
        channels = (*config.channels[::-1], in_features(config))
        self.upsamplings = nnx.List([SubPixelUpsampling(a, b, rngs=rngs) for a, b in itertools.pairwise(channels)])

    def __call__(self, latent: Array) -> Array:
        """Returns the image f32[decoder_size, decoder_size, C] in [0, 1] of `latent`, f32[Z]."""
        x = self.dense(latent).reshape(self.shape)
        for upsampling in self.upsamplings:
            x = upsampling(jax.nn.relu(x))
        return jax.nn.sigmoid(x)


def build(key: Array, config: Config) -> tuple[Encoder, Decoder]:
    """Builds the two networks, encoder and decoder, as flax.nnx modules with random parameters.

    Args:
      key: PRNG key of the parameters.
      config: the run's config; its encoder part and the image size are used.
    """
    encoder_key, decoder_key = jax.random.split(key)
    encoder = Encoder(config.encoder, config.scene.image_size, rngs=nnx.Rngs(encoder_key))
    return encoder, Decoder(config.encoder, rngs=nnx.Rngs(decoder_key))


@functools.cache
def _graphs(config: Config) -> tuple[nnx.GraphDef[Encoder], nnx.GraphDef[Decoder]]:
    """Returns the graph definitions of encoder and decoder: the modules without their parameters."""
    encoder, decoder = nnx.eval_shape(lambda: build(jax.random.key(0), config))
    return nnx.graphdef(encoder), nnx.graphdef(decoder)


def init_params(key: Array, config: Config) -> ParamTree:
    """Returns random parameters as a dictionary with the keys `encoder` and `decoder`. The pose loss has no decoder.

    Args:
      key: PRNG key of the parameters.
      config: the run's config; its encoder part and the image size are used.
    """
    encoder, decoder = build(key, config)
    params: ParamTree = {"encoder": nnx.to_pure_dict(nnx.state(encoder))}
    if config.encoder.loss != "pose":
        params["decoder"] = nnx.to_pure_dict(nnx.state(decoder))
    return params


def raw_latent(params: ParamTree, x: Array, config: Config) -> Array:
    """Encodes an input image: computes its raw latent, the encoder's output vector before any normalisation.

    Args:
      params: parameters of encoder and decoder.
      x: image f32[H, W, C] in [0, 1] with C channels, from `network_input`.
      config: the run's config.

    Returns:
      Raw latent, f32[Z]; Z is `config.encoder.code_size`.
    """
    return nnx.merge(_graphs(config)[0], params["encoder"])(x)


def reconstruct(params: ParamTree, latent: Array, config: Config) -> Array:
    """Decodes a raw latent (encoder output): returns the decoder's image, which shows the object without disturbances.

    Args:
      params: parameters of encoder and decoder.
      latent: f32[Z], raw latent of Z numbers.
      config: the run's config.

    Returns:
      Image f32[decoder_size, decoder_size, C] in [0, 1] with C channels.
    """
    return nnx.merge(_graphs(config)[1], params["decoder"])(latent)


def code_of(encoder: EncoderState, raw: Array) -> Array:
    """Normalises a raw latent (encoder output) to a code. Searchers compare codes, and the policy reads them.

    The code is the raw latent minus the mean latent, partially whitened, and scaled to mean square 1 (norm sqrt(Z)).
    An all-zero code stays zero, and its gradients are finite.

    Args:
      encoder: state that holds the mean latent and the whitening matrix.
      raw: f32[Z], raw latent of Z numbers.

    Returns:
      Code, f32[Z].
    """
    code = encoder.whitening @ (raw - encoder.latent_mean)
    return code * jax.lax.rsqrt(jnp.maximum(jnp.mean(code**2), 1e-12))


def encode(encoder: EncoderState, x: Array, config: Config) -> Array:
    """Computes the code of an input image. The code is the encoder's output, normalised by `code_of`.

    Args:
      encoder: the trained autoencoder.
      x: image f32[H, W, C] in [0, 1] with C channels, from `network_input`.
      config: the run's config.

    Returns:
      Code, f32[Z] of Z numbers.
    """
    return code_of(encoder, raw_latent(encoder.params, x, config))


def network_input(image: Image, object_geom_ids: Array | tuple[int, ...], config: Config) -> Array:
    """Converts a rendered image to the encoder's input image, of the kind that `config.encoder.input` names.

    - "rgb": the colours of the image.
    - "silhouette": 1 in pixels that show the object, else 0.
    - "depth": depth along the optical axis, scaled linearly and clipped to [0, 1]. 0 is half the camera's distance from
      the object, 1 is one and a half times that distance. A pixel that shows nothing is 1.

    Args:
      image: rendered image of H x W pixels.
      object_geom_ids: i32[G], MuJoCo's numbers of the G geoms of the object.
      config: the run's config.

    Returns:
      Input image f32[H, W, C] in [0, 1]; C is 3 for rgb, else 1.
    """
    if config.encoder.input == "rgb":
        return image.rgb
    if config.encoder.input == "depth":
        return jnp.clip(image.depth / config.scene.radius - 0.5, 0.0, 1.0)[..., None]
    is_object = jnp.any(image.geom_id[..., None] == jnp.asarray(object_geom_ids)[None, None], axis=-1)
    return is_object[..., None].astype(jnp.float32)
