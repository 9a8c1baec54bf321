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


class Job(NamedTuple):
    """What a lane does; functions of one item.

    Attributes:
      begin: (problem, state, is_new bool[]) -> state: of a new problem where `is_new`, else unchanged. It gets the old
        state, so that large buffers need not be cleared.
      step: (problem, state) -> state; a state that is done must come back unchanged.
      is_done: state -> bool[].
      finish: (problem, state) -> result.
    """

    begin: Callable[[Any, Any, Array], Any]
    step: Callable[[Any, Any], Any]
    is_done: Callable[[Any], Array]
    finish: Callable[[Any, Any], Any]


class _Run(NamedTuple):
    """Lanes with the problems they hold (index `size` where they idle), the queue's head, and the results so far."""

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
      results: pytree, leading axis N, as `job.finish` returns them.
    """
    size, num_lanes = order[0].shape[0], jax.tree.leaves(states)[0].shape[0]
    queue, count = order

    def is_idle(held: Array) -> Array:
        return held >= size

    def refill(state: _Run) -> _Run:
        rank = state.head + jnp.cumsum(is_idle(state.held)) - 1
        is_new = is_idle(state.held) & (rank < count)
        held = jnp.where(is_new, queue[jnp.clip(rank, 0, size - 1)], state.held)
        states = jax.vmap(job.begin)(_rows(problems, held), state.states, is_new)
        return state._replace(states=states, held=held, head=state.head + jnp.sum(is_new, dtype=jnp.int32))

    def work(state: _Run) -> _Run:
        state = refill(state)
        current = _rows(problems, state.held)
        num_held = jnp.sum(~is_idle(state.held))
        # At the queue's end nobody can be refilled, so the lanes run on until all have finished.
        enough = jnp.where(state.head < count, jnp.maximum(num_held // REFILL_SHARE, 1), num_held)

        def goes_on(states: Any) -> Array:
            return jnp.sum(jax.vmap(job.is_done)(states) & ~is_idle(state.held)) < enough

        states = jax.lax.while_loop(goes_on, lambda states: jax.vmap(job.step)(current, states), state.states)
        is_done = jax.vmap(job.is_done)(states) & ~is_idle(state.held)
        row = jnp.where(is_done, state.held, size)
        found = jax.vmap(job.finish)(current, states)
        results = jax.tree.map(lambda old, new: old.at[row].set(new, mode="drop"), state.results, found)
        return state._replace(states=states, held=jnp.where(is_done, size, state.held), results=results)

    def is_open(state: _Run) -> Array:
        return (state.head < count) | jnp.any(~is_idle(state.held))

    start = _Run(states, jnp.full(num_lanes, size, jnp.int32), jnp.int32(0), results)
    return jax.lax.while_loop(is_open, work, start).results


def in_order(is_wanted: Array) -> tuple[Array, Array]:
    """Returns the `order` that works on the problems where `is_wanted` (bool[N]), first to last."""
    return jnp.argsort(~is_wanted).astype(jnp.int32), jnp.sum(is_wanted, dtype=jnp.int32)


def _rows(problems: Any, index: Array) -> Any:
    return jax.tree.map(lambda leaf: leaf[jnp.minimum(index, leaf.shape[0] - 1)], problems)


def flattened(function: Callable[..., Any]) -> Callable[..., Any]:
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
