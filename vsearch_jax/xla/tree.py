"""Operations on whole pytrees."""

from __future__ import annotations

from typing import TypeVar

import jax
import jax.numpy as jnp
from jax import Array

Tree = TypeVar("Tree")


def tree_zeros(tree: Tree, leading: tuple[int, ...] = ()) -> Tree:
    """Returns zeros with the shapes and dtypes of a pytree.

    Args:
      tree: pytree of arrays, or of `jax.ShapeDtypeStruct`.
      leading: axes that are added in front of each shape.
    """
    return jax.tree.map(lambda x: jnp.zeros((*leading, *x.shape), x.dtype), tree)


def tree_where(condition: Array, if_true: Tree, if_false: Tree) -> Tree:
    """Selects between two pytrees by a condition, leaf by leaf, as `jnp.where` does for arrays.

    Args:
      condition: bool[], or of a shape that broadcasts with every leaf.
      if_true: pytree of arrays, returned where `condition` is true.
      if_false: pytree of the same structure, returned elsewhere.

    Returns:
      Pytree of the same structure.
    """
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), if_true, if_false)
