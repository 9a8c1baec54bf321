"""How batches are laid out and cut: some items at a time to bound memory, the batch axis last where that is faster."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array


def map_in_batches(function: Any, xs: Any, batch_size: int) -> Any:
    """Returns `function` over the leading axis of `xs`, `batch_size` items at a time.

    Unlike `jax.lax.map` it compiles `function` once also where batches do not come out even: the last item is repeated.
    """
    count = jax.tree.leaves(xs)[0].shape[0]
    batch_size = max(1, min(batch_size, count))
    index = jnp.minimum(jnp.arange(count + -count % batch_size), count - 1)
    results = jax.lax.map(function, jax.tree.map(lambda x: x[index], xs), batch_size=batch_size)
    return jax.tree.map(lambda x: x[:count], results)


def batch_axis_last(function: Callable[[Any, Any], Any]) -> Callable[[Any, Any], Any]:
    """Makes `vmap` of a function put the batch axis last, where XLA for CPU vectorises over it and gathers whole rows.

    Args:
      function: (fixed pytree, pytree of arrays) -> pytree of arrays. It takes and returns arrays with one axis more at
        the end, too, and then works on each of that axis by itself.

    Returns:
      The same function. Under `vmap` over the second argument alone; `fixed` cannot be mapped over.
    """
    batched = jax.custom_batching.custom_vmap(function)

    @batched.def_vmap
    def rule(axis_size: int, in_batched: list[Any], fixed: Any, items: Any) -> tuple[Any, Any]:
        if any(jax.tree.leaves(in_batched[0])):
            raise NotImplementedError("the arm cannot be mapped over: call the function once for each arm")

        def last(leaf: Array, is_mapped: bool) -> Array:
            return (
                jnp.moveaxis(leaf, 0, -1) if is_mapped else jnp.broadcast_to(leaf[..., None], (*leaf.shape, axis_size))
            )

        results = function(fixed, jax.tree.map(last, items, in_batched[1]))
        results = jax.tree.map(lambda leaf: jnp.moveaxis(leaf, -1, 0), results)
        return results, jax.tree.map(lambda _: True, results)

    return batched


def append_axes(leaf: Array, batch: int) -> Array:
    """Returns `leaf` with `batch` axes of length one more at the end, to go with arrays that have the batch there."""
    return leaf.reshape(*leaf.shape, *[1] * batch)
