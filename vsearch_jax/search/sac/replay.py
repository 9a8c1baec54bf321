"""Replay buffer with uniform sampling: a ring buffer that a loop carries.

brax's UniformSamplingQueue makes room by a roll of the whole buffer inside a `cond`. Under `jax.vmap` over seeds both
branches run, so every insertion would copy the buffer. Here an insertion writes only the new rows.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import Array

from vsearch_jax.types import ReplayState, Transition
from vsearch_jax.xla.tree import tree_zeros


def init_replay(example: Transition, capacity: int) -> ReplayState:
    """Creates an empty replay buffer for episode steps (transitions).

    Args:
      example: one Transition without a batch axis. Only shapes and dtypes are read.
      capacity: maximum number of transitions in the buffer.

    Returns:
      The buffer, without transitions.
    """
    return ReplayState(data=tree_zeros(example, (capacity,)), num_inserted=jnp.zeros((), jnp.int32))


def insert(replay: ReplayState, transitions: Transition) -> ReplayState:
    """Inserts new episode steps (transitions) into the replay buffer. In a full buffer they overwrite the oldest ones.

    Args:
      replay: the buffer before the insertion.
      transitions: the new transitions, with a leading batch axis, not longer than the capacity.

    Returns:
      The buffer after the insertion.
    """
    count, capacity = transitions.reward.shape[0], replay.data.reward.shape[0]
    index = (replay.num_inserted + jnp.arange(count)) % capacity
    data = jax.tree.map(lambda old, new: old.at[index].set(new), replay.data, transitions)
    return ReplayState(data=data, num_inserted=replay.num_inserted + count)


def sample_batch(key: Array, replay: ReplayState, batch_size: int) -> Transition:
    """Draws a random batch of episode steps (transitions) from the replay buffer, uniformly and with replacement.

    Args:
      key: PRNG key.
      replay: the buffer, with at least one transition.
      batch_size: number of transitions to draw.

    Returns:
      The drawn transitions: a Transition with leading axis `batch_size`.
    """
    num_filled = jnp.minimum(replay.num_inserted, replay.data.reward.shape[0])
    index = jax.random.randint(key, (batch_size,), 0, num_filled)
    return jax.tree.map(lambda x: x[index], replay.data)
