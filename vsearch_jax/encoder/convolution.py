"""Strided convolutions of one image. Batch them with `jax.vmap`."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
from jax import Array


def convolve(x: Array, kernel: Array, stride: int) -> Array:
    """Computes a strided convolution of one image, with "SAME" padding, by the faster way on the present platform.

    On CPU the forward pass is XLA's own operation, and the backward pass is slices and one matmul; forward-mode
    differentiation is not defined there. On other platforms both are XLA's.

    Args:
      x: f32[H, W, C], image with C channels; H and W are multiples of `stride`.
      kernel: f32[k, k, C, K] for C input and K output channels; k is the width of the kernel in pixels, k >= stride.
      stride: distance s in pixels between kernel positions.

    Returns:
      f32[H/s, W/s, K], image with K channels.
    """
    if jax.default_backend() != "cpu":
        return convolution_by_xla(x, kernel, stride)
    y: Array = _convolve_on_cpu(x, kernel, stride)  # custom_vjp hides the type
    return y


def convolution_by_xla(x: Array, kernel: Array, stride: int) -> Array:
    """Computes `convolve` by XLA's own operation.

    Args:
      x: as of `convolve`.
      kernel: as of `convolve`.
      stride: as of `convolve`.
    """
    dimensions = ("NHWC", "HWIO", "NHWC")
    return jax.lax.conv_general_dilated(x[None], kernel, (stride, stride), "SAME", dimension_numbers=dimensions)[0]


def convolution_by_matmul(x: Array, kernel: Array, stride: int) -> Array:
    """Computes `convolve` by slices and one matmul.

    On CPU its backward pass is the faster one: inside a loop that of XLA's own operation is 40 times slower.

    Args:
      x: as of `convolve`.
      kernel: as of `convolve`.
      stride: as of `convolve`.
    """
    size, _, in_features, out_features = kernel.shape
    height, width = x.shape[0] // stride, x.shape[1] // stride
    before = (size - stride) // 2
    x = jnp.pad(x, ((before, size - stride - before), (before, size - stride - before), (0, 0)))
    if size == 2 * stride:
        # The kernel covers 2 x 2 blocks of s x s pixels, so four wide slices replace k * k narrow ones.
        x = x.reshape(height + 1, stride, width + 1, stride, in_features)
        x = x.transpose(0, 2, 1, 3, 4).reshape(height + 1, width + 1, stride * stride * in_features)
        taps = [x[i : i + height, j : j + width] for i in range(2) for j in range(2)]
        kernel = kernel.reshape(2, stride, 2, stride, in_features, out_features).transpose(0, 2, 1, 3, 4, 5)
    else:
        rows, columns = stride * (height - 1) + 1, stride * (width - 1) + 1
        taps = [x[i : i + rows : stride, j : j + columns : stride] for i in range(size) for j in range(size)]
    return jnp.concatenate(taps, axis=-1) @ kernel.reshape(-1, out_features)


@functools.partial(jax.custom_vjp, nondiff_argnums=(2,))
def _convolve_on_cpu(x: Array, kernel: Array, stride: int) -> Array:
    """Has the forward pass of `convolution_by_xla` and the backward pass of `convolution_by_matmul`."""
    return convolution_by_xla(x, kernel, stride)


def _forward(x: Array, kernel: Array, stride: int) -> tuple[Array, tuple[Array, Array]]:
    return convolution_by_xla(x, kernel, stride), (x, kernel)


def _backward(stride: int, inputs: tuple[Array, Array], gradient: Array) -> tuple[Array, Array]:
    _, pullback = jax.vjp(functools.partial(convolution_by_matmul, stride=stride), *inputs)
    return pullback(gradient)


_convolve_on_cpu.defvjp(_forward, _backward)
