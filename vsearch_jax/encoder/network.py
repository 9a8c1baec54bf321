"""The autoencoder: strided convolutions to a latent, sub-pixel matmuls back to a picture; one in, batch by vmap."""

from __future__ import annotations

import functools
import itertools
import math
from typing import Any

import jax
import jax.numpy as jnp
from flax import nnx
from jax import Array

from vsearch_jax.config import Config, EncoderConfig
from vsearch_jax.types import EncoderState, Image

Params = dict[str, Any]


def convolution_by_xla(x: Array, kernel: Array, stride: int) -> Array:
    """Returns XLA's own strided convolution with "SAME" padding: f32[H, W, C], f32[k, k, C, K] -> f32[H/s, W/s, K]."""
    dimensions = ("NHWC", "HWIO", "NHWC")
    return jax.lax.conv_general_dilated(x[None], kernel, (stride, stride), "SAME", dimension_numbers=dimensions)[0]


def convolution_by_matmul(x: Array, kernel: Array, stride: int) -> Array:
    """Returns what `convolution_by_xla` does, as copies of slices and one matmul.

    On CPU, XLA differentiates it faster than its own convolution, which in a loop falls back to a single-threaded one.

    Args:
      x: f32[H, W, C]; H and W are multiples of `stride`.
      kernel: f32[k, k, C, K], k >= stride.
      stride: s.

    Returns:
      f32[H/s, W/s, K].
    """
    size, _, in_features, out_features = kernel.shape
    height, width = x.shape[0] // stride, x.shape[1] // stride
    before = (size - stride) // 2
    x = jnp.pad(x, ((before, size - stride - before), (before, size - stride - before), (0, 0)))
    if size == 2 * stride:
        # Blocks of s x s pixels, then each block with its neighbours right, below and diagonal: few, wide copies.
        x = x.reshape(height + 1, stride, width + 1, stride, in_features)
        x = x.transpose(0, 2, 1, 3, 4).reshape(height + 1, width + 1, stride * stride * in_features)
        taps = [x[i : i + height, j : j + width] for i in range(2) for j in range(2)]
        kernel = kernel.reshape(2, stride, 2, stride, in_features, out_features).transpose(0, 2, 1, 3, 4, 5)
    else:
        rows, columns = stride * (height - 1) + 1, stride * (width - 1) + 1
        taps = [x[i : i + rows : stride, j : j + columns : stride] for i in range(size) for j in range(size)]
    return jnp.concatenate(taps, axis=-1) @ kernel.reshape(-1, out_features)


class StridedConvolution(nnx.Module):
    """A convolution with a stride: as a matmul on CPU, XLA's own elsewhere."""

    def __init__(self, in_features: int, out_features: int, kernel_size: int, stride: int, *, rngs: nnx.Rngs) -> None:
        shape = (kernel_size, kernel_size, in_features, out_features)
        self.kernel = nnx.Param(jax.nn.initializers.he_normal()(rngs.params(), shape))
        self.bias = nnx.Param(jnp.zeros(out_features))
        self.stride = stride

    def __call__(self, x: Array) -> Array:
        """Returns f32[H/s, W/s, K] from `x` f32[H, W, C]."""
        convolution = convolution_by_matmul if jax.default_backend() == "cpu" else convolution_by_xla
        return convolution(x, self.kernel[...], self.stride) + self.bias[None, None]


class SubPixelUpsampling(nnx.Module):
    """Twice the height and width: a matmul gives each cell the features of its four quarters (Shi et al. 2016)."""

    def __init__(self, in_features: int, out_features: int, *, rngs: nnx.Rngs) -> None:
        self.linear = nnx.Linear(in_features, 4 * out_features, kernel_init=jax.nn.initializers.he_normal(), rngs=rngs)

    def __call__(self, x: Array) -> Array:
        """Returns f32[2H, 2W, K] from `x` f32[H, W, C]."""
        height, width, _ = x.shape
        x = self.linear(x).reshape(height, width, 2, 2, -1)
        return x.transpose(0, 2, 1, 3, 4).reshape(2 * height, 2 * width, -1)


def in_features(config: EncoderConfig) -> int:
    """Returns the channels of the network's input: 3 for rgb, 1 for depth and silhouette."""
    return 3 if config.input == "rgb" else 1


class Encoder(nnx.Module):
    """Picture to raw latent."""

    def __init__(self, config: EncoderConfig, image_size: int, *, rngs: nnx.Rngs) -> None:
        sizes = [2 * config.stem_stride if config.stem_stride > 2 else config.kernel_size]
        sizes += [config.kernel_size] * (len(config.channels) - 1)
        strides = [config.stem_stride] + [2] * (len(config.channels) - 1)
        inputs = (in_features(config), *config.channels[:-1])
        layers = zip(inputs, config.channels, sizes, strides, strict=True)
        self.convolutions = nnx.List([StridedConvolution(*layer, rngs=rngs) for layer in layers])
        cells = (image_size // math.prod(strides)) ** 2
        self.dense = nnx.Linear(cells * config.channels[-1], config.code_size, rngs=rngs)

    def __call__(self, x: Array) -> Array:
        """Returns the raw latent f32[Z] of `x`, f32[H, W, C]."""
        for convolution in self.convolutions:
            x = jax.nn.relu(convolution(x))
        return self.dense(x.reshape(-1))


class Decoder(nnx.Module):
    """Raw latent to the clean picture."""

    def __init__(self, config: EncoderConfig, *, rngs: nnx.Rngs) -> None:
        self.shape = (config.decoder_size // 2 ** len(config.channels),) * 2 + (config.channels[-1],)
        self.dense = nnx.Linear(
            config.code_size, math.prod(self.shape), kernel_init=jax.nn.initializers.he_normal(), rngs=rngs
        )
        channels = (*config.channels[::-1], in_features(config))
        self.upsamplings = nnx.List([SubPixelUpsampling(a, b, rngs=rngs) for a, b in itertools.pairwise(channels)])

    def __call__(self, latent: Array) -> Array:
        """Returns the picture f32[decoder_size, decoder_size, C] of `latent`, f32[Z]."""
        x = self.dense(latent).reshape(self.shape)
        for upsampling in self.upsamplings:
            x = upsampling(jax.nn.relu(x))
        return jax.nn.sigmoid(x)


def build(key: Array, config: Config) -> tuple[Encoder, Decoder]:
    """Returns the two modules with parameters drawn from `key`."""
    encoder_key, decoder_key = jax.random.split(key)
    encoder = Encoder(config.encoder, config.scene.image_size, rngs=nnx.Rngs(encoder_key))
    return encoder, Decoder(config.encoder, rngs=nnx.Rngs(decoder_key))


@functools.cache
def _graphs(config: Config) -> tuple[nnx.GraphDef, nnx.GraphDef]:
    """Returns the static halves of encoder and decoder."""
    encoder, decoder = nnx.eval_shape(lambda: build(jax.random.key(0), config))
    return nnx.graphdef(encoder), nnx.graphdef(decoder)


def init_params(key: Array, config: Config) -> Params:
    """Returns fresh parameters as nested dictionaries of arrays, `encoder` and `decoder` apart."""
    encoder, decoder = build(key, config)
    return {
        "encoder": nnx.to_pure_dict(nnx.state(encoder)),
        "decoder": nnx.to_pure_dict(nnx.state(decoder)),
    }


def raw_latent(params: Params, x: Array, config: Config) -> Array:
    """Returns the encoder's raw latent f32[Z] of the input `x`, f32[H, W, C] from `network_input`."""
    return nnx.merge(_graphs(config)[0], params["encoder"])(x)


def reconstruct(params: Params, latent: Array, config: Config) -> Array:
    """Returns the decoder's picture f32[decoder_size, decoder_size, C] in [0, 1] of a raw latent f32[Z]."""
    return nnx.merge(_graphs(config)[1], params["decoder"])(latent)


def code_of(encoder: EncoderState, raw: Array) -> Array:
    """Returns the code that searchers compare and the policy reads, f32[Z], of a raw latent f32[Z].

    The code is the raw latent without its mean, partially whitened, scaled to mean square 1 (norm sqrt(Z)); an all-zero
    code stays zero, with finite gradients.
    """
    code = encoder.whitening @ (raw - encoder.latent_mean)
    return code * jax.lax.rsqrt(jnp.maximum(jnp.mean(code**2), 1e-12))


def encode(encoder: EncoderState, x: Array, config: Config) -> Array:
    """Returns the code f32[Z] (see `code_of`) of the input `x`, f32[H, W, C] from `network_input`."""
    return code_of(encoder, raw_latent(encoder.params, x, config))


def network_input(image: Image, object_geom_ids: Array | tuple[int, ...], config: Config) -> Array:
    """Returns of an image what the config lets the encoder read, f32[H, W, C] in [0, 1].

    rgb is taken as it is. Depth d becomes d/radius - 1/2, limited to [0, 1]: half a sphere's radius before and behind
    its centre; what is nearer, farther or a miss is at the limit. The silhouette is 1 on the object.

    Args:
      image: Image of H x W.
      object_geom_ids: i32[G], MuJoCo's numbers of the object's geoms.
      config: the run's.
    """
    if config.encoder.input == "rgb":
        return image.rgb
    if config.encoder.input == "depth":
        return jnp.clip(image.depth / config.scene.radius - 0.5, 0.0, 1.0)[..., None]
    is_object = jnp.any(image.geom_id[..., None] == jnp.asarray(object_geom_ids)[None, None], axis=-1)
    return is_object[..., None].astype(jnp.float32)
