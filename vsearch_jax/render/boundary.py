"""A boundary that XLA's fusion does not cross."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from jax import Array


@jax.custom_jvp
def materialize(tree: Any, zero: Array) -> Any:
    """Returns `tree` as it is, but written to memory before it is used.

    XLA on CPU fuses whatever it can and computes anew what several results share; `optimization_barrier` does not stop
    it. The arguments of a loop are written, though, even if its run-time number of iterations is none.

    Args:
      tree: pytree of arrays.
      zero: i32[], always 0, in a way that the compiler cannot know; see `unknown_zero`.
    """

    def is_left(state: tuple[Array, Any]) -> Array:
        return state[0] < zero

    def body(state: tuple[Array, Any]) -> tuple[Array, Any]:
        return state[0] + 1, jax.tree.map(lambda leaf: leaf + jnp.ones((), leaf.dtype), state[1])

    return jax.lax.while_loop(is_left, body, (jnp.zeros((), jnp.int32), tree))[1]


@materialize.defjvp
def _materialize_jvp(primals: tuple[Any, Array], tangents: tuple[Any, Any]) -> tuple[Any, Any]:
    return materialize(*primals), tangents[0]


def unknown_zero(positive: Array) -> Array:
    """Returns i32[] 0, computed from f32[] `positive`, which the caller knows to be above 0."""
    return (jax.lax.stop_gradient(positive) < 0.0).astype(jnp.int32)
