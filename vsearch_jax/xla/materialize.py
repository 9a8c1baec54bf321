"""A boundary that XLA's fusion does not cross."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from jax import Array


def _is_left(state: tuple[Array, Array, Any]) -> Array:
    return state[0] < state[1]


def _change(state: tuple[Array, Array, Any]) -> tuple[Array, Array, Any]:
    # Never runs; a body that changed nothing would be optimised away.
    return state[0] + 1, state[1], jax.tree.map(lambda leaf: leaf + jnp.ones((), leaf.dtype), state[2])


@jax.custom_jvp
def materialize(tree: Any, zero: Array) -> Any:
    """Returns `tree` as it is, but written to memory before it is used.

    XLA on CPU fuses whatever it can and computes anew what several results share; `optimization_barrier` does not stop
    it. The arguments of a loop are written, though, even if its run-time number of iterations is none.

    Args:
      tree: pytree of arrays of numbers.
      zero: i32[], always 0, in a way that the compiler cannot know; see `runtime_zero`.
    """
    return jax.lax.while_loop(_is_left, _change, (jnp.zeros_like(zero), zero, tree))[2]


@materialize.defjvp
def _materialize_jvp(primals: tuple[Any, Array], tangents: tuple[Any, Any]) -> tuple[Any, Any]:
    return materialize(*primals), tangents[0]


def runtime_zero(lengths: Array) -> Array:
    """Returns i32[] 0, computed from `lengths` (any shape).

    They must be known at run time only: what the compiler can compute is no secret to it.
    """
    lengths = jax.lax.stop_gradient(lengths)
    return jnp.any(jnp.where(lengths < 1e30, lengths, 0.0) > 1e30).astype(jnp.int32)
