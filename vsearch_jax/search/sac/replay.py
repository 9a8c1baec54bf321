"""Uniform replay in a ring buffer that lives in a loop's carry.

brax's UniformSamplingQueue makes room by rolling the whole buffer inside a `cond`; under vmap over seeds both branches
run, so every insertion would copy the buffer. Here an insertion writes its own rows only.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import Array

from vsearch_jax.types import ReplayState, Transition


def init_replay(example: Transition, capacity: int) -> ReplayState:
    """Returns an empty buffer for `capacity` transitions like `example`, which has no batch axis."""
    data = jax.tree.map(lambda x: jnp.zeros((capacity, *x.shape), x.dtype), example)
    return ReplayState(data=data, num_inserted=jnp.zeros((), jnp.int32))


def insert(replay: ReplayState, transitions: Transition) -> ReplayState:
    """Returns the buffer with `transitions` (leading batch axis, at most the capacity) in place of the oldest."""
    count, capacity = transitions.reward.shape[0], replay.data.reward.shape[0]
    index = (replay.num_inserted + jnp.arange(count)) % capacity
    data = jax.tree.map(lambda old, new: old.at[index].set(new), replay.data, transitions)
    return ReplayState(data=data, num_inserted=replay.num_inserted + count)


def sample_batch(key: Array, replay: ReplayState, batch_size: int) -> Transition:
    """Returns `batch_size` transitions drawn uniformly with replacement; the buffer must not be empty."""
    num_filled = jnp.minimum(replay.num_inserted, replay.data.reward.shape[0])
    index = jax.random.randint(key, (batch_size,), 0, num_filled)
    return jax.tree.map(lambda x: x[index], replay.data)
