"""Actor and critic of soft actor-critic as flax.nnx modules. Their parameters are kept apart, as `nnx.State`."""

from __future__ import annotations

import functools
import itertools
from typing import TypeAlias

import jax
import jax.numpy as jnp
from flax import nnx
from jax import Array


class Actor(nnx.Module):
    """Maps an obs to the parameters of a tanh-normal distribution over actions."""

    def __init__(self, sizes: tuple[int, ...], rngs: nnx.Rngs) -> None:
        """Creates random layers.

        Args:
          sizes: number of units of each layer, from the input to the output.
          rngs: random streams of flax.
        """
        self.layers = nnx.List([nnx.Linear(i, o, rngs=rngs) for i, o in itertools.pairwise(sizes)])

    def __call__(self, obs: Array) -> Array:
        """Returns f32[..., sizes[-1]]: the means, then the inputs of softplus, which gives the standard deviations."""
        *hidden_layers, last_layer = self.layers
        hidden = obs
        for layer in hidden_layers:
            hidden = nnx.relu(layer(hidden))
        return last_layer(hidden)


class Critic(nnx.Module):
    """Maps an obs and an action to one value. Layer norm precedes each activation."""

    def __init__(self, sizes: tuple[int, ...], rngs: nnx.Rngs) -> None:
        """Creates random layers.

        Args:
          sizes: number of units of each layer, from the input (obs and action) to the output.
          rngs: random streams of flax.
        """
        self.layers = nnx.List([nnx.Linear(i, o, rngs=rngs) for i, o in itertools.pairwise(sizes)])
        self.norms = nnx.List([nnx.LayerNorm(size, rngs=rngs) for size in sizes[1:-1]])

    def __call__(self, obs: Array, action: Array) -> Array:
        """Computes the value of an action.

        Args:
          obs: f32[..., D].
          action: f32[..., A] in [-1, 1].

        Returns:
          f32[...].
        """
        *hidden_layers, last_layer = self.layers
        hidden = jnp.concatenate([obs, action], axis=-1)
        for layer, norm in zip(hidden_layers, self.norms, strict=True):
            hidden = nnx.relu(norm(layer(hidden)))
        return last_layer(hidden)[..., 0]


class Value(nnx.Module):
    """Maps an obs to the value of the state. Layer norm precedes each activation, as in the critic."""

    def __init__(self, sizes: tuple[int, ...], rngs: nnx.Rngs) -> None:
        """Creates random layers.

        Args:
          sizes: number of units of each layer, from the input to the output.
          rngs: random streams of flax.
        """
        self.critic = Critic(sizes, rngs)

    def __call__(self, obs: Array) -> Array:
        """Returns the values f32[...] of the states with the given obs, f32[..., D]."""
        return self.critic(obs, obs[..., :0])


Network: TypeAlias = Actor | Critic | Value


def init_network(key: Array, network: type[Network], sizes: tuple[int, ...]) -> nnx.State:
    """Creates random parameters of a policy network (Actor), critic or state value network (Value).

    Args:
      key: PRNG key.
      network: Actor, Critic or Value.
      sizes: number of units of each layer, from the input to the output.

    Returns:
      The parameters.
    """
    return nnx.split(network(sizes, nnx.Rngs(key)))[1]


def apply_network(network: type[Network], sizes: tuple[int, ...], params: nnx.State, *inputs: Array) -> Array:
    """Computes the output of a policy network (Actor), critic or state value network (Value) for given inputs.

    Args:
      network: Actor, Critic or Value.
      sizes: numbers of units: of the whole input, of each hidden layer, of the output.
      params: parameters from `init_network` with the same `network` and `sizes`.
      *inputs: the obs f32[..., O]; for a Critic also the action f32[..., A].

    Returns:
      An Actor's distribution parameters f32[..., sizes[-1]], or values f32[...] (the last size is 1).
    """
    return nnx.merge(_graphdef(network, sizes), params)(*inputs)


@functools.cache
def _graphdef(network: type[Network], sizes: tuple[int, ...]) -> nnx.GraphDef[Network]:
    """Returns the structure of a network without its parameters."""
    abstract = nnx.eval_shape(lambda: network(sizes, nnx.Rngs(jax.random.key(0))))
    return nnx.split(abstract)[0]
