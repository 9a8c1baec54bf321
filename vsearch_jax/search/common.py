"""Parts of the black-box searchers: the search problem, the record of the evaluations, and the loop of a search."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Generic, NamedTuple, TypeVar

import flax.struct
import jax
import jax.numpy as jnp
from jax import Array

from vsearch_jax.geometry import wrap_angle
from vsearch_jax.types import SearchResult, View

Task = TypeVar("Task")
Task_co = TypeVar("Task_co", covariant=True)
SearchState = TypeVar("SearchState")

ScoreFn = Callable[[View, Task], Array]
"""`score_fn(view, task) -> f32[]`: cosine similarity to the target at `view`, or -inf where the arm cannot reach it."""


@flax.struct.dataclass
class SearchArgs(Generic[Task_co]):
    """One search problem. Every field may be batched by `jax.vmap`.

    Attributes:
      initial: View of f32[] rad, where the search starts. Its image is the first evaluation.
      band: f32[2] rad, lowest and highest elevation of the search.
      threshold: f32[], score from which the target counts as found; the search ends then.
      task: any pytree, for instance the target code. The searcher only passes it to `score_fn`.
    """

    initial: View
    band: Array
    threshold: Array
    task: Task_co


@flax.struct.dataclass
class Record:
    """What a search has found so far. A generation is a set of views that the searcher asks for at once.

    G is the maximum number of generations.

    Attributes:
      view: View of f32[] rad, the best view; the initial view if no other is better.
      score: f32[], score of `view`.
      best_scores: f32[G], best score after each generation; the present best score fills the rest.
      evaluations: i32[], number of images taken.
      unreachable: i32[], number of those images' views that the arm could not reach.
      generation: i32[], number of generations done.
      best: i32[], index of `view` in the last generation; -1 if `view` is older.
    """

    view: View
    score: Array
    best_scores: Array
    evaluations: Array
    unreachable: Array
    generation: Array
    best: Array


class Method(NamedTuple, Generic[SearchState]):
    """A black-box searcher in parts, for callers that take the images themselves.

    A generation is a set of N = `num_views` views that the searcher asks for at once.

    Attributes:
      start: (args, score of the initial view f32[]) -> state, a pytree.
      ask: (key, args, state) -> (views, state). `views` is the next generation, View of f32[N] rad. `key` is the key of
        the whole search; it is equal in every generation.
      tell: (key, args, state, views, scores f32[N]) -> state. `state` is the state that `ask` returned.
      record: state -> Record.
      num_views: number of views in a generation.
      counts: state -> the searcher's own counts by name, i32[] or i32[G] for G generations, for example
        `num_restarts`.
    """

    start: Callable[[SearchArgs[object], Array], SearchState]
    ask: Callable[[Array, SearchArgs[object], SearchState], tuple[View, SearchState]]
    tell: Callable[[Array, SearchArgs[object], SearchState, View, Array], SearchState]
    record: Callable[[SearchState], Record]
    num_views: int
    counts: Callable[[SearchState], dict[str, Array]] = lambda state: {}


def run_search(
    key: Array, score_fn: ScoreFn[Task], args: SearchArgs[Task], method: Method[SearchState]
) -> SearchResult:
    """Runs one search until the best score meets the threshold, or until no generations are left.

    Args:
      key: PRNG key.
      score_fn: maps (view, args.task) to the score f32[]: cosine similarity to the target, or -inf where the arm cannot
        reach the view. `jax.vmap` is applied to it over a generation (the views that the searcher asks for at once).
      args: initial view, band of elevations, threshold and task of one search problem.
      method: the searcher.

    Returns:
      The best view, its score and the number of images taken.
    """
    state = method.start(args, score_fn(args.initial, args.task))
    body = functools.partial(_run_generation, key, score_fn, args, method)
    state = jax.lax.while_loop(lambda state: is_running(method.record(state), args.threshold), body, state)
    return to_result(method.record(state))


def _run_generation(
    key: Array, score_fn: ScoreFn[Task], args: SearchArgs[Task], method: Method[SearchState], state: SearchState
) -> SearchState:
    views, state = method.ask(key, args, state)
    scores = jax.vmap(score_fn, in_axes=(0, None))(views, args.task)
    return method.tell(key, args, state, views, scores)


def start_record(view: View, score: Array, max_generations: int) -> Record:
    """Starts the record of what a search has found: it holds the initial view and the one image taken there.

    Args:
      view: the initial view, f32[] rad.
      score: f32[], score of the initial view; -inf if the arm cannot reach it.
      max_generations: number of generations after which the search gives up.
    """
    return Record(
        view=view,
        score=score,
        best_scores=jnp.full((max_generations,), score),
        evaluations=jnp.int32(1),
        unreachable=jnp.isneginf(score).astype(jnp.int32),
        generation=jnp.int32(0),
        best=jnp.int32(-1),
    )


def taken_images(scores: Array, threshold: Array) -> Array:
    """Marks which images of a generation are taken: all up to the first whose score meets the threshold.

    A generation is a set of N views that the searcher asks for at once.

    Args:
      scores: f32[N], scores of the views in the order in which the images are taken.
      threshold: f32[], score at which the search ends.

    Returns:
      bool[N], true for the images that are taken.
    """
    is_hit = (scores >= threshold).astype(jnp.int32)
    return jnp.cumsum(is_hit) - is_hit == 0


def add_generation(record: Record, views: View, scores: Array, threshold: Array) -> Record:
    """Updates the record of a search with one generation: N views that the searcher asked for, and their scores.

    The record counts as if the arm had visited the views in order and stopped at the first score >= threshold. Later
    views are not counted and cannot become the best view. Unreachable views before it are counted.

    Args:
      record: the record before the generation; the search must not have ended.
      views: View whose azimuth and elevation are f32[N] rad each.
      scores: f32[N], scores of `views`; -inf where the arm cannot reach the view.
      threshold: f32[], score at which the search ends.

    Returns:
      What the search has found after the generation.
    """
    is_taken = taken_images(scores, threshold)
    taken_scores = jnp.where(is_taken, scores, -jnp.inf)
    best = jnp.argmax(taken_scores)
    is_better = taken_scores[best] > record.score
    score = jnp.where(is_better, taken_scores[best], record.score)
    return Record(
        view=View(
            azimuth=jnp.where(is_better, views.azimuth[best], record.view.azimuth),
            elevation=jnp.where(is_better, views.elevation[best], record.view.elevation),
        ),
        score=score,
        best_scores=jnp.where(jnp.arange(record.best_scores.shape[0]) >= record.generation, score, record.best_scores),
        evaluations=record.evaluations + jnp.sum(is_taken, dtype=jnp.int32),
        unreachable=record.unreachable + jnp.sum(is_taken & jnp.isneginf(scores), dtype=jnp.int32),
        generation=record.generation + 1,
        best=jnp.where(is_better, best, -1).astype(jnp.int32),
    )


def is_running(record: Record, threshold: Array) -> Array:
    """Checks whether a search goes on: the best score is below the threshold, and generations are left.

    Args:
      record: what the search has found so far.
      threshold: f32[], score at which the search ends.

    Returns:
      bool[], true if the search goes on.
    """
    return (record.score < threshold) & (record.generation < record.best_scores.shape[0])


def to_result(record: Record) -> SearchResult:
    """Converts the record of a finished search to its result. The azimuth of the best view is wrapped to [-pi, pi)."""
    return SearchResult(
        view=View(azimuth=wrap_angle(record.view.azimuth), elevation=record.view.elevation),
        score=record.score,
        best_scores=record.best_scores,
        evaluations=record.evaluations,
        unreachable=record.unreachable,
    )
