"""What the black-box searchers share: the problem, the record of what was seen, and the fold into the band."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import flax.struct
import jax
import jax.numpy as jnp
from jax import Array

from vsearch_jax.geometry import wrap_angle
from vsearch_jax.types import SearchResult, View

ScoreFn = Callable[[View, Any], Array]
"""`score_fn(view, task) -> f32[]`: cosine similarity to the target at `view`, -inf where the arm cannot reach it."""


@flax.struct.dataclass
class SearchArgs:
    """One search problem; everything in it may be batched with `jax.vmap`.

    Attributes:
      initial: View of f32[] rad, where the arm starts; its image is the first evaluation.
      band: f32[2] rad, lowest and highest elevation to search.
      threshold: f32[], the score at which the search ends.
      task: any pytree, handed to `score_fn` untouched: the scene, encoder and target code, for instance.
    """

    initial: View
    band: Array
    threshold: Array
    task: Any


@flax.struct.dataclass
class Record:
    """What a search has seen so far; G is the most generations.

    Attributes:
      view: View of f32[] rad, the best view seen; the initial view while nothing better was seen.
      score: f32[], its score.
      best_scores: f32[G], best score after each generation, the present one repeated to the end.
      evaluations: i32[], images taken.
      unreachable: i32[], how many of them the arm could not reach.
      generation: i32[], generations done.
      best: i32[], which of the last generation's views it is; -1 if none of them.
    """

    view: View
    score: Array
    best_scores: Array
    evaluations: Array
    unreachable: Array
    generation: Array
    best: Array


class Method(NamedTuple):
    """A black-box searcher in parts, for callers that take the images of several searchers in one place.

    Attributes:
      start: (args, score of the initial view f32[]) -> state, any pytree.
      ask: (key, args, state) -> the next generation, View of f32[num_views] rad, and the state that waits for it. The
        key is the search's, the same in every generation.
      tell: (key, args, state, views, scores f32[num_views]) -> state.
      record: state -> Record.
      num_views: views of a generation.
    """

    start: Callable[[SearchArgs, Array], Any]
    ask: Callable[[Array, SearchArgs, Any], tuple[View, Any]]
    tell: Callable[[Array, SearchArgs, Any, View, Array], Any]
    record: Callable[[Any], Record]
    num_views: int


def run_search(key: Array, score_fn: ScoreFn, args: SearchArgs, method: Method) -> SearchResult:
    """Returns what `method` finds; `score_fn` is vmapped over the views of a generation."""
    state = method.start(args, score_fn(args.initial, args.task))
    body = functools.partial(_generation, key, score_fn, args, method)
    state = jax.lax.while_loop(lambda state: is_running(method.record(state), args.threshold), body, state)
    return to_result(method.record(state))


def _generation(key: Array, score_fn: ScoreFn, args: SearchArgs, method: Method, state: Any) -> Any:
    views, state = method.ask(key, args, state)
    scores = jax.vmap(score_fn, in_axes=(0, None))(views, args.task)
    return method.tell(key, args, state, views, scores)


def start_record(view: View, score: Array, max_generations: int) -> Record:
    """Returns the record after the image of the initial `view` (View of f32[] rad), whose score is `score` (f32[])."""
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
    """Returns bool[N], which of a generation's images are taken: none after the first whose score meets `threshold`."""
    is_hit = (scores >= threshold).astype(jnp.int32)
    return jnp.cumsum(is_hit) - is_hit == 0


def add_generation(record: Record, views: View, scores: Array, threshold: Array) -> Record:
    """Returns `record` with one more generation of `views` (View of f32[N] rad) and their `scores` (f32[N]).

    The images are taken one by one and the search ends with the first that meets `threshold` (f32[]); those after it
    are not taken, so they neither count nor enter the best.
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
    """Returns bool[]: the threshold (f32[]) is not met and generations are left."""
    return (record.score < threshold) & (record.generation < record.best_scores.shape[0])


def to_result(record: Record) -> SearchResult:
    """Returns the SearchResult of a finished search; its azimuth is in [-pi, pi)."""
    return SearchResult(
        view=View(azimuth=wrap_angle(record.view.azimuth), elevation=record.view.elevation),
        score=record.score,
        best_scores=record.best_scores,
        evaluations=record.evaluations,
        unreachable=record.unreachable,
    )


def fold_into_band(elevation: Array, band: Array) -> Array:
    """Returns `elevation` (rad, any shape) reflected at the ends of `band` (f32[2] rad) until it lies inside.

    Reflection keeps the density of the samples smooth, where clipping would heap them on the band's edges. A band of no
    width gives its one elevation.
    """
    width = band[1] - band[0]
    period = jnp.where(width > 0.0, 2.0 * width, 1.0)
    offset = jnp.mod(elevation - band[0], period)
    folded = band[0] + jnp.minimum(offset, period - offset)
    return jnp.where(width > 0.0, jnp.clip(folded, band[0], band[1]), band[0])
