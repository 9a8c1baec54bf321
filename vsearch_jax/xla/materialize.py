"""A fusion boundary for XLA.

XLA on CPU fuses an expression into every place that uses it, and computes it again there. `optimization_barrier` does
not prevent this. A loop does: its operands are written to memory, even if the loop runs zero times.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
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


# Replaces the choice by platform; see `override_materialize`.
_overridden: list[bool] = []


def _is_enabled() -> bool:
    """Returns whether `materialize` does anything. Measured on CPU only, so other platforms leave fusion to XLA."""
    return _overridden[-1] if _overridden else jax.default_backend() == "cpu"


@contextlib.contextmanager
def override_materialize(is_enabled: bool) -> Iterator[None]:
    """Switches `materialize` on or off in a `with` block, for measurements; read at trace time.

    JAX does not know that a traced function depends on it, so its caches are cleared at both ends of the block.

    Args:
      is_enabled: whether `materialize` forces its values to memory.
    """
    _overridden.append(is_enabled)
    jax.clear_caches()
    try:
        yield
    finally:
        _overridden.pop()
        jax.clear_caches()


def materialize(tree: Tree, zero: Array) -> Tree:
    """Returns `tree` unchanged. On CPU it also forces XLA to write the tree to memory once.

    Args:
      tree: pytree of numeric arrays.
      zero: i32[], 0 at run time. Must not be a compile-time constant; see `runtime_zero`.

    Returns:
      The same values. Derivatives pass through.
    """
    return _materialize(tree, zero) if _is_enabled() else tree


@jax.custom_jvp
def _materialize(tree: Tree, zero: Array) -> Tree:
    return jax.lax.while_loop(_has_next, _change_all, (jnp.zeros_like(zero), zero, tree))[2]


@_materialize.defjvp
def _materialize_jvp(primals: tuple[Tree, Array], tangents: tuple[Tree, Array]) -> tuple[Tree, Tree]:
    return _materialize(*primals), tangents[0]


def runtime_zero(values: Array) -> Array:
    """Returns 0 as i32[], computed at run time, so that the compiler cannot know its value. `materialize` needs it.

    Args:
      values: f32 of any shape, from which the zero is computed. Must not be a compile-time constant.
    """
    values = jax.lax.stop_gradient(values)
    return jnp.any(jnp.where(values < 1e30, values, 0.0) > 1e30).astype(jnp.int32)
