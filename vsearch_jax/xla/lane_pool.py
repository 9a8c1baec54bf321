"""Many problems of unequal length over a fixed number of lanes, inside one traced loop.

Under `vmap` a loop runs until its slowest item ends, and every item pays for that. Here each lane takes the next
problem of the queue when its own is done, as a pool of workers would; memory does not grow with the problems.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

# Lanes are refilled once this share of them has finished: refilling costs about as much as a few steps.
REFILL_SHARE = 8
# At the end this share of the lanes goes on alone, and of those again.
TAIL_SHARES = (4, 4)


class Job(NamedTuple):
    """What a lane does; functions of one item.

    Attributes:
      reset: (problem, state, is_new bool[]) -> state: of a new problem where `is_new`, else unchanged. It gets the old
        state, so that large buffers need not be cleared.
      step: (problem, state) -> state; a state that is done must come back unchanged.
      is_done: state -> bool[].
      result: (problem, state) -> result.
      has_stragglers: some problems take many more steps than others. Then the last few go on alone, which
        is compiled apart and so takes longer to compile.
    """

    reset: Callable[[Any, Any, Array], Any]
    step: Callable[[Any, Any], Any]
    is_done: Callable[[Any], Array]
    result: Callable[[Any, Any], Any]
    has_stragglers: bool = True


class _Run(NamedTuple):
    """Lanes with the problems they hold (its number N where they idle), the queue's head, and the results so far."""

    states: Any
    held: Array
    head: Array
    results: Any


def run(job: Job, problems: Any, order: tuple[Array, Array], states: Any, results: Any) -> Any:
    """Returns `results` with the rows of the problems that were worked on replaced.

    Args:
      job: what to do.
      problems: pytree, leading axis N.
      order: i32[N], which problem comes when, and i32[], how many of them are worked on.
      states: pytree, leading axis L: the lanes; their content is overwritten.
      results: pytree, leading axis N, as `job.result` returns them.
    """
    num_problems, num_lanes = order[0].shape[0], jax.tree.leaves(states)[0].shape[0]
    state = _Run(states, jnp.full(num_lanes, num_problems, jnp.int32), jnp.int32(0), results)
    # When the queue is empty and few are left, these go on alone: all lanes cost the same, idle or not.
    for share in TAIL_SHARES if job.has_stragglers else ():
        few = state.held.shape[0] // share
        if few == 0:
            break
        state = _loop(job, problems, order, state, few)
        busy = jnp.argsort(state.held >= num_problems)[:few]
        state = state._replace(states=_rows(state.states, busy), held=state.held[busy])
    return _loop(job, problems, order, state, 0).results


def _loop(job: Job, problems: Any, order: tuple[Array, Array], state: _Run, few: int) -> _Run:
    """Works until the queue is empty and no more than `few` lanes are busy."""
    idle, count = order[0].shape[0], order[1]

    def is_open(state: _Run) -> Array:
        return (state.head < count) | (jnp.sum(state.held < idle) > few)

    def work(state: _Run) -> _Run:
        state = _refill(job, problems, order, state)
        current, is_held = _rows(problems, state.held), state.held < idle
        num_held = jnp.sum(is_held)
        # At the queue's end nobody can be refilled.
        enough = jnp.where(state.head < count, num_held // REFILL_SHARE, num_held - few)

        def goes_on(states: Any) -> Array:
            return jnp.sum(jax.vmap(job.is_done)(states) & is_held) < jnp.maximum(enough, 1)

        states = jax.lax.while_loop(goes_on, lambda states: jax.vmap(job.step)(current, states), state.states)
        is_done = jax.vmap(job.is_done)(states) & is_held
        row = jnp.where(is_done, state.held, idle)
        found = jax.vmap(job.result)(current, states)
        results = jax.tree.map(lambda old, new: old.at[row].set(new, mode="drop"), state.results, found)
        return state._replace(states=states, held=jnp.where(is_done, idle, state.held), results=results)

    return jax.lax.while_loop(is_open, work, state)


def _refill(job: Job, problems: Any, order: tuple[Array, Array], state: _Run) -> _Run:
    """Gives the next problems of the queue to idle lanes."""
    (queue, count), idle = order, order[0].shape[0]
    rank = state.head + jnp.cumsum(state.held >= idle) - 1
    is_new = (state.held >= idle) & (rank < count)
    held = jnp.where(is_new, queue[jnp.clip(rank, 0, idle - 1)], state.held)
    states = jax.vmap(job.reset)(_rows(problems, held), state.states, is_new)
    return state._replace(states=states, held=held, head=state.head + jnp.sum(is_new, dtype=jnp.int32))


def queue_where(is_wanted: Array) -> tuple[Array, Array]:
    """Returns the `order` that works on the problems where `is_wanted` (bool[N]), first to last."""
    return jnp.argsort(~is_wanted).astype(jnp.int32), jnp.sum(is_wanted, dtype=jnp.int32)


def _rows(problems: Any, index: Array) -> Any:
    return jax.tree.map(lambda leaf: leaf[jnp.minimum(index, leaf.shape[0] - 1)], problems)


def flatten_vmap(function: Callable[..., Any]) -> Callable[..., Any]:
    """Makes `vmap` of a batched function one larger batch instead of a loop in a loop.

    Args:
      function: (shared pytree, batched pytree, leading axis N) -> pytree, leading axis N.

    Returns:
      The same function. Under `vmap` over the second argument alone the batch is A * N; `shared` cannot be mapped.
    """
    batched = jax.custom_batching.custom_vmap(function)

    @batched.def_vmap
    def rule(axis_size: int, in_batched: list[Any], shared: Any, problems: Any) -> tuple[Any, Any]:
        if any(jax.tree.leaves(in_batched[0])):
            raise NotImplementedError("the arm cannot be mapped over: call the function once for each arm")
        whole = jax.tree.map(
            lambda leaf, is_mapped: leaf if is_mapped else jnp.broadcast_to(leaf[None], (axis_size, *leaf.shape)),
            problems,
            in_batched[1],
        )
        flat = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), whole)
        results = batched(shared, flat)
        results = jax.tree.map(lambda leaf: leaf.reshape(axis_size, -1, *leaf.shape[1:]), results)
        return results, jax.tree.map(lambda _: True, results)

    return batched
