"""Actor and critic of soft actor-critic as flax.nnx modules, split to pytrees of parameters."""

from __future__ import annotations

import functools
import itertools
from typing import Any

import jax
import jax.numpy as jnp
from flax import nnx
from jax import Array


class Actor(nnx.Module):
    """Observation to the parameters of a tanh-normal distribution over actions."""

    def __init__(self, sizes: tuple[int, ...], rngs: nnx.Rngs) -> None:
        """Makes layers of `sizes`, input and output included."""
        self.layers = nnx.List([nnx.Linear(i, o, rngs=rngs) for i, o in itertools.pairwise(sizes)])

    def __call__(self, observation: Array) -> Array:
        """Returns f32[..., sizes[-1]]: means, then what softplus turns into standard deviations."""
        *hidden_layers, last_layer = self.layers
        hidden = observation
        for layer in hidden_layers:
            hidden = nnx.relu(layer(hidden))
        return last_layer(hidden)


class Critic(nnx.Module):
    """Observation and action to one value, with layer norm before each activation."""

    def __init__(self, sizes: tuple[int, ...], rngs: nnx.Rngs) -> None:
        """Makes layers of `sizes`, input and output included."""
        self.layers = nnx.List([nnx.Linear(i, o, rngs=rngs) for i, o in itertools.pairwise(sizes)])
        self.norms = nnx.List([nnx.LayerNorm(size, rngs=rngs) for size in sizes[1:-1]])

    def __call__(self, observation: Array, action: Array) -> Array:
        """Returns the value, f32[...]."""
        *hidden_layers, last_layer = self.layers
        hidden = jnp.concatenate([observation, action], axis=-1)
        for layer, norm in zip(hidden_layers, self.norms, strict=True):
            hidden = nnx.relu(norm(layer(hidden)))
        return last_layer(hidden)[..., 0]


def init_network(key: Array, network: type[nnx.Module], sizes: tuple[int, ...]) -> Any:
    """Returns fresh parameters, a pytree, of a `network` whose layers have `sizes`."""
    return nnx.split(network(sizes, nnx.Rngs(key)))[1]  # pyright: ignore[reportCallIssue] # Actor's and Critic's signature


def apply_network(network: type[nnx.Module], sizes: tuple[int, ...], params: Any, *inputs: Array) -> Array:
    """Returns the output of a `network` whose layers have `sizes`, with `params`, for `inputs` of any leading axes."""
    return nnx.merge(_graphdef(network, sizes), params)(*inputs)  # pyright: ignore[reportCallIssue] # modules are callable


@functools.cache
def _graphdef(network: type[nnx.Module], sizes: tuple[int, ...]) -> Any:
    abstract = nnx.eval_shape(lambda: network(sizes, nnx.Rngs(jax.random.key(0))))  # pyright: ignore[reportCallIssue]
    return nnx.split(abstract)[0]
