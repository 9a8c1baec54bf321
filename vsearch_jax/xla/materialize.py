"""A fusion boundary for XLA.

XLA on CPU fuses an expression into every place that uses it, and computes it again there. `optimization_barrier` does
not prevent this. A loop does: its operands are written to memory, even if the loop runs zero times.
"""

from __future__ import annotations

from typing import TypeVar

import jax
import jax.numpy as jnp
from jax import Array

Tree = TypeVar("Tree")


def _has_next(state: tuple[Array, Array, Tree]) -> Array:
    return state[0] < state[1]


def _change_all(state: tuple[Array, Array, Tree]) -> tuple[Array, Array, Tree]:
    # Never runs. XLA would remove a body that leaves the tree unchanged.
    return state[0] + 1, state[1], jax.tree.map(lambda leaf: leaf + jnp.ones((), leaf.dtype), state[2])


@jax.custom_jvp
def materialize(tree: Tree, zero: Array) -> Tree:
    """Returns `tree` unchanged, but forces XLA to compute its arrays once and to write them to memory.

    Otherwise XLA on CPU may compute them again for each use.

    Args:
      tree: pytree of numeric arrays.
      zero: i32[], 0 at run time. Must not be a compile-time constant; see `runtime_zero`.

    Returns:
      `tree`. Derivatives pass through unchanged.
    """
    return jax.lax.while_loop(_has_next, _change_all, (jnp.zeros_like(zero), zero, tree))[2]


@materialize.defjvp
def _materialize_jvp(primals: tuple[Tree, Array], tangents: tuple[Tree, Array]) -> tuple[Tree, Tree]:
    return materialize(*primals), tangents[0]


def runtime_zero(values: Array) -> Array:
    """Returns 0 as i32[], computed at run time, so that the compiler cannot know its value. `materialize` needs it.

    Args:
      values: f32 of any shape, from which the zero is computed. Must not be a compile-time constant.
    """
    values = jax.lax.stop_gradient(values)
    return jnp.any(jnp.where(values < 1e30, values, 0.0) > 1e30).astype(jnp.int32)
