"""Layout and size of batches: chunks of a bounded size, one flat batch under nested `vmap`, the batch axis last."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import jax
import jax.numpy as jnp
from jax import Array

Shared = TypeVar("Shared")
Items = TypeVar("Items")
Results = TypeVar("Results")


def map_in_batches(function: Callable[[Items], Results], items: Items, batch_size: int) -> Results:
    """Applies `function` to each of N items, `batch_size` items at a time.

    If `batch_size` does not divide N, `jax.lax.map` compiles a second program for the remainder. `map_in_batches`
    repeats the last item instead, so one program is enough.

    Args:
      function: maps one item to one result.
      items: pytree, leading axis N.
      batch_size: number of items in a batch; limited to the range 1 to N.

    Returns:
      Pytree of results, leading axis N.
    """
    count = jax.tree.leaves(items)[0].shape[0]
    batch_size = max(1, min(batch_size, count))
    index = jnp.minimum(jnp.arange(count + -count % batch_size), count - 1)
    results = jax.lax.map(function, jax.tree.map(lambda x: x[index], items), batch_size=batch_size)
    return jax.tree.map(lambda x: x[:count], results)


def flatten_vmap(function: Callable[[Shared, Items], Results]) -> Callable[[Shared, Items], Results]:
    """Changes the `vmap` of a batched function: the function is called once, with one larger batch.

    Use it for functions that loop over their batch. Plain `vmap` would put a loop inside a loop.

    Args:
      function: (shared, items with leading axis N) -> results with leading axis N.

    Returns:
      `function` with a new `vmap` rule. Under `vmap` with axis size A over the second argument, it runs on A * N items.
      `vmap` over the first argument raises NotImplementedError.
    """

    def run_flat(shared: Shared, items: Items) -> Results:
        axis_size = jax.tree.leaves(items)[0].shape[0]
        flat = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), items)
        results = batched(shared, flat)
        return jax.tree.map(lambda leaf: leaf.reshape(axis_size, -1, *leaf.shape[1:]), results)

    batched = _with_vmap_rule(function, run_flat)
    return batched


def batch_axis_last(function: Callable[[Shared, Items], Results]) -> Callable[[Shared, Items], Results]:
    """Changes the `vmap` of a function: the function is called once, on arrays with the batch axis last.

    On CPU, XLA vectorises over the last axis. If the batch is the last axis, a gather also copies whole rows.

    Args:
      function: (shared, items) -> results. It must also accept items whose arrays have one more axis at the end, and
        then treat each position of that axis independently.

    Returns:
      `function` with a new `vmap` rule. `vmap` over the first argument raises NotImplementedError.
    """

    def run_last(shared: Shared, items: Items) -> Results:
        results = function(shared, jax.tree.map(lambda leaf: jnp.moveaxis(leaf, 0, -1), items))
        return jax.tree.map(lambda leaf: jnp.moveaxis(leaf, -1, 0), results)

    return _with_vmap_rule(function, run_last)


def _with_vmap_rule(
    function: Callable[[Shared, Items], Results], run_batch: Callable[[Shared, Items], Results]
) -> Callable[[Shared, Items], Results]:
    """Returns `function` with `run_batch` as its batching rule. Items without a batch axis are repeated."""
    batched = jax.custom_batching.custom_vmap(function)

    @batched.def_vmap
    def rule(axis_size: int, in_batched: tuple[Shared, Items], shared: Shared, items: Items) -> tuple[Results, Results]:
        if any(jax.tree.leaves(in_batched[0])):
            raise NotImplementedError(
                "vmap over the first argument is not supported; call the function once for each value of it"
            )
        repeated = jax.tree.map(
            lambda leaf, is_mapped: leaf if is_mapped else jnp.broadcast_to(leaf[None], (axis_size, *leaf.shape)),
            items,
            in_batched[1],
        )
        results = run_batch(shared, repeated)
        return results, jax.tree.map(lambda _: True, results)

    return batched


def append_axes(leaf: Array, count: int) -> Array:
    """Returns `leaf` with axes of length 1 at the end, so that it broadcasts with arrays whose batch axes are last.

    Args:
      leaf: array of any shape.
      count: number of axes to append.
    """
    return leaf.reshape(*leaf.shape, *[1] * count)
