"""Actor and critic of soft actor-critic as flax.nnx modules. Their parameters are kept apart, as `nnx.State`."""

from __future__ import annotations

import functools
import itertools
from typing import TypeAlias

import jax
import jax.numpy as jnp
from flax import nnx
from jax import Array


class CodePair(nnx.Module):
    """Reads the present code and the target code of an obs with shared layers (a siamese network).

    Both codes show the same object, so what is learned of one serves the other. Near the target the difference of the
    two results keeps the small part in which the codes differ.
    """

    def __init__(self, code_size: int, width: int, rngs: nnx.Rngs) -> None:
        """Creates random layers.

        Args:
          code_size: number of entries in a code.
          width: number of units of each of the two layers.
          rngs: random streams of flax.
        """
        self.first, self.second = nnx.Linear(code_size, width, rngs=rngs), nnx.Linear(width, width, rngs=rngs)

    def __call__(self, obs: Array) -> Array:
        """Maps an obs f32[..., D] to f32[..., 2 * width + D - 2 * code_size].

        The result holds the features of the present code, how far those of the target code differ, and the rest of the
        obs.
        """
        size = self.first.in_features
        present, target = (
            self.second(nnx.relu(self.first(code))) for code in (obs[..., :size], obs[..., size : 2 * size])
        )
        return jnp.concatenate([present, target - present, obs[..., 2 * size :]], axis=-1)


def _first_layers(sizes: tuple[int, ...], code_size: int, rngs: nnx.Rngs) -> tuple[CodePair | None, tuple[int, ...]]:
    """Returns the layers that read the codes, or None; and the numbers of units from there to the output."""
    if code_size == 0:
        return None, sizes
    num_inputs, width, *rest = sizes
    return CodePair(code_size, width, rngs), (2 * width + num_inputs - 2 * code_size, *rest)


class Actor(nnx.Module):
    """Maps an obs to the parameters of a tanh-normal distribution over actions."""

    def __init__(self, sizes: tuple[int, ...], code_size: int, rngs: nnx.Rngs) -> None:
        """Creates random layers.

        Args:
          sizes: number of units of each layer, from the input to the output.
          code_size: number of entries in a code, if the obs starts with two codes that shared layers read; else 0.
          rngs: random streams of flax.
        """
        self.pair, sizes = _first_layers(sizes, code_size, rngs)
        self.layers = nnx.List([nnx.Linear(i, o, rngs=rngs) for i, o in itertools.pairwise(sizes)])

    def __call__(self, obs: Array) -> Array:
        """Returns f32[..., sizes[-1]]: the means, then the inputs of softplus, which gives the standard deviations."""
        *hidden_layers, last_layer = self.layers
        hidden = obs if self.pair is None else self.pair(obs)
        for layer in hidden_layers:
            hidden = nnx.relu(layer(hidden))
        return last_layer(hidden)


class Critic(nnx.Module):
    """Maps an obs and an action to one value. Layer norm precedes each activation but that of the shared layers."""

    def __init__(self, sizes: tuple[int, ...], code_size: int, rngs: nnx.Rngs) -> None:
        """Creates random layers.

        Args:
          sizes: number of units of each layer, from the input (obs and action) to the output.
          code_size: as for `Actor`.
          rngs: random streams of flax.
        """
        self.pair, sizes = _first_layers(sizes, code_size, rngs)
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
        hidden = hidden if self.pair is None else self.pair(hidden)
        for layer, norm in zip(hidden_layers, self.norms, strict=True):
            hidden = nnx.relu(norm(layer(hidden)))
        return last_layer(hidden)[..., 0]


class Value(nnx.Module):
    """Maps an obs to the value of the state. It is a critic without action."""

    def __init__(self, sizes: tuple[int, ...], code_size: int, rngs: nnx.Rngs) -> None:
        """Creates random layers.

        Args:
          sizes: number of units of each layer, from the input to the output.
          code_size: as for `Actor`.
          rngs: random streams of flax.
        """
        self.critic = Critic(sizes, code_size, rngs)

    def __call__(self, obs: Array) -> Array:
        """Returns the values f32[...] of the states with the given obs, f32[..., D]."""
        return self.critic(obs, obs[..., :0])


Network: TypeAlias = Actor | Critic | Value


def init_network(key: Array, network: type[Network], sizes: tuple[int, ...], code_size: int) -> nnx.State:
    """Creates random parameters of a policy network (Actor), critic or state value network (Value).

    Args:
      key: PRNG key.
      network: Actor, Critic or Value.
      sizes: number of units of each layer, from the input to the output.
      code_size: number of entries in a code, if the obs starts with two codes that shared layers read; else 0.

    Returns:
      The parameters.
    """
    return nnx.split(network(sizes, code_size, nnx.Rngs(key)))[1]


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
    return nnx.merge(_graphdef(network, sizes, _code_size(params)), params)(*inputs)


def _code_size(params: nnx.State) -> int:
    """Returns the number of entries in a code, if shared layers read the codes; else 0."""
    kernels = [leaf for path, leaf in nnx.to_flat_state(params) if path[-3:] == ("pair", "first", "kernel")]
    return kernels[0].shape[0] if kernels else 0


@functools.cache
def _graphdef(network: type[Network], sizes: tuple[int, ...], code_size: int) -> nnx.GraphDef[Network]:
    """Returns the structure of a network without its parameters."""
    abstract = nnx.eval_shape(lambda: network(sizes, code_size, nnx.Rngs(jax.random.key(0))))
    return nnx.split(abstract)[0]
