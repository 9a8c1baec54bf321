"""Many items, some at a time: what bounds the memory of a program."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp


def map_batched(function: Any, xs: Any, batch_size: int) -> Any:
    """Returns `function` over the leading axis of `xs`, `batch_size` items at a time.

    Unlike `jax.lax.map` it compiles `function` once also where batches do not come out even: the last item is repeated.
    """
    count = jax.tree.leaves(xs)[0].shape[0]
    batch_size = max(1, min(batch_size, count))
    index = jnp.minimum(jnp.arange(count + -count % batch_size), count - 1)
    results = jax.lax.map(function, jax.tree.map(lambda x: x[index], xs), batch_size=batch_size)
    return jax.tree.map(lambda x: x[:count], results)
