"""Runs N problems of unequal length on L lanes, inside one traced loop.

Under `vmap` a loop runs until its slowest item ends, and each item pays for that. Here a lane takes the next problem of
a queue as soon as its own is done. Memory grows with the number of lanes, not with the number of problems.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Generic, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jax import Array

Problem = TypeVar("Problem")
State = TypeVar("State")
Result = TypeVar("Result")
Tree = TypeVar("Tree")

# Lanes are refilled once 1/8 of the busy lanes have finished. A refill costs about as much as a few steps.
REFILL_SHARE = 8
# An idle lane costs as much as a busy lane. So when the queue is empty, the last problems move to 1/4 of the lanes, and
# later to 1/4 of those.
TAIL_SHARES = (4, 4)


class Job(NamedTuple, Generic[Problem, State, Result]):
    """The functions that a lane (a slot that works on one problem at a time) runs. Each function handles one problem.

    Attributes:
      reset: (problem, state, is_new bool[]) -> state. Returns the start state of `problem` where `is_new`, else the
        given state. It receives the old state so that large buffers need not be cleared.
      step: (problem, state) -> state. Must return a finished state unchanged.
      is_done: state -> bool[].
      result: (problem, state) -> result.
      has_stragglers: whether a few problems take many more steps than the others. The last few then continue on fewer
        lanes. This loop is compiled separately, so it costs compile time.
    """

    reset: Callable[[Problem, State, Array], State]
    step: Callable[[Problem, State], State]
    is_done: Callable[[State], Array]
    result: Callable[[Problem, State], Result]
    has_stragglers: bool = True


class Queue(NamedTuple):
    """Which of N problems to run, and in which order.

    Attributes:
      order: i32[N], numbers of the problems; the problems to run come first.
      num_queued: i32[], number of problems to run.
    """

    order: Array
    num_queued: Array


class _Run(NamedTuple, Generic[State, Result]):
    """The loop's state.

    Attributes:
      states: the lanes' states, leading axis L.
      held: i32[L], number of the problem that each lane holds; N where it is idle.
      head: i32[], index in the queue of the next problem.
      results: pytree, leading axis N.
    """

    states: State
    held: Array
    head: Array
    results: Result


def queue_where(is_wanted: Array) -> Queue:
    """Returns a queue of those of N problems that are to be run, in ascending order of their numbers.

    Args:
      is_wanted: bool[N], true for a problem to run.
    """
    return Queue(jnp.argsort(~is_wanted).astype(jnp.int32), jnp.sum(is_wanted, dtype=jnp.int32))


def run(job: Job[Problem, State, Result], problems: Problem, queue: Queue, states: State, results: Result) -> Result:
    """Runs the queued ones of N problems on L lanes (slots that work on one problem at a time).

    A lane takes the next problem of the queue as soon as its present problem is done.

    Args:
      job: the functions that start, step and finish one problem.
      problems: pytree, leading axis N.
      queue: which problems to run, and in which order.
      states: pytree, leading axis L, one state for each lane. Only the shapes matter; the values are overwritten.
      results: pytree, leading axis N, of the structure that `job.result` returns.

    Returns:
      `results` with the rows of the queued problems replaced.
    """
    num_problems, num_lanes = queue.order.shape[0], jax.tree.leaves(states)[0].shape[0]
    state = _Run(states, jnp.full(num_lanes, num_problems, jnp.int32), jnp.int32(0), results)
    for share in TAIL_SHARES if job.has_stragglers else ():
        num_left = state.held.shape[0] // share
        if num_left == 0:
            break
        state = _run_until(job, problems, queue, state, num_left)
        busy = jnp.argsort(state.held >= num_problems)[:num_left]
        state = state._replace(states=_rows(state.states, busy), held=state.held[busy])
    return _run_until(job, problems, queue, state, 0).results


def _run_until(
    job: Job[Problem, State, Result], problems: Problem, queue: Queue, state: _Run[State, Result], num_left: int
) -> _Run[State, Result]:
    """Runs until the queue is empty and at most `num_left` lanes are busy."""
    idle = queue.order.shape[0]

    def has_work(state: _Run[State, Result]) -> Array:
        return (state.head < queue.num_queued) | (jnp.sum(state.held < idle) > num_left)

    def refill_and_step(state: _Run[State, Result]) -> _Run[State, Result]:
        state = _refill(job, problems, queue, state)
        current, is_held = _rows(problems, state.held), state.held < idle
        num_held = jnp.sum(is_held)
        # When the queue is empty, no lane can be refilled.
        enough = jnp.where(state.head < queue.num_queued, num_held // REFILL_SHARE, num_held - num_left)

        def is_below_refill(states: State) -> Array:
            return jnp.sum(jax.vmap(job.is_done)(states) & is_held) < jnp.maximum(enough, 1)

        states = jax.lax.while_loop(is_below_refill, lambda states: jax.vmap(job.step)(current, states), state.states)
        is_done = jax.vmap(job.is_done)(states) & is_held
        row = jnp.where(is_done, state.held, idle)
        found = jax.vmap(job.result)(current, states)
        results = jax.tree.map(lambda old, new: old.at[row].set(new, mode="drop"), state.results, found)
        return state._replace(states=states, held=jnp.where(is_done, idle, state.held), results=results)

    return jax.lax.while_loop(has_work, refill_and_step, state)


def _refill(
    job: Job[Problem, State, Result], problems: Problem, queue: Queue, state: _Run[State, Result]
) -> _Run[State, Result]:
    """Gives the next problems of the queue to idle lanes."""
    idle = queue.order.shape[0]
    rank = state.head + jnp.cumsum(state.held >= idle) - 1
    is_new = (state.held >= idle) & (rank < queue.num_queued)
    held = jnp.where(is_new, queue.order[jnp.clip(rank, 0, idle - 1)], state.held)
    states = jax.vmap(job.reset)(_rows(problems, held), state.states, is_new)
    return state._replace(states=states, held=held, head=state.head + jnp.sum(is_new, dtype=jnp.int32))


def _rows(tree: Tree, index: Array) -> Tree:
    """Returns the rows `index` of each leaf. An index after the last row returns the last row."""
    return jax.tree.map(lambda leaf: leaf[jnp.minimum(index, leaf.shape[0] - 1)], tree)
