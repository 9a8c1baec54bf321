"""Replay buffer with uniform sampling: a ring buffer that a loop carries.

brax's UniformSamplingQueue makes room by a roll of the whole buffer inside a `cond`. Under `jax.vmap` over seeds both
branches run, so every insertion would copy the buffer. Here an insertion writes only the new rows.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import Array

from vsearch_jax.types import ReplayState, Transition


def init_replay(example: Transition, capacity: int) -> ReplayState:
    """Creates an empty buffer.

    Args:
      example: one Transition without a batch axis. Its shapes and dtypes count, its values do not.
      capacity: maximum number of transitions.

    Returns:
      ReplayState without transitions.
    """
    data = jax.tree.map(lambda x: jnp.zeros((capacity, *x.shape), x.dtype), example)
    return ReplayState(data=data, num_inserted=jnp.zeros((), jnp.int32))


def insert(replay: ReplayState, transitions: Transition) -> ReplayState:
    """Inserts transitions. They overwrite the oldest ones if the buffer is full.

    Args:
      replay: ReplayState.
      transitions: Transition with a leading batch axis, not longer than the capacity.

    Returns:
      ReplayState with the transitions.
    """
    count, capacity = transitions.reward.shape[0], replay.data.reward.shape[0]
    index = (replay.num_inserted + jnp.arange(count)) % capacity
    data = jax.tree.map(lambda old, new: old.at[index].set(new), replay.data, transitions)
    return ReplayState(data=data, num_inserted=replay.num_inserted + count)


def sample_batch(key: Array, replay: ReplayState, batch_size: int) -> Transition:
    """Draws transitions uniformly, with replacement.

    Args:
      key: PRNG key.
      replay: ReplayState with at least one transition.
      batch_size: number of transitions to draw.

    Returns:
      Transition with leading axis `batch_size`.
    """
    num_filled = jnp.minimum(replay.num_inserted, replay.data.reward.shape[0])
    index = jax.random.randint(key, (batch_size,), 0, num_filled)
    return jax.tree.map(lambda x: x[index], replay.data)
