"""Random search around the best view so far (thesis 4.1), with a share of samples from the whole band."""

from __future__ import annotations

import functools

import flax.struct
import jax
import jax.numpy as jnp
from jax import Array

from vsearch_jax.config import RandomSearchConfig
from vsearch_jax.geometry import fold_into_band, view_from_uniform, wrap_angle
from vsearch_jax.search.common import (
    Method,
    Record,
    ScoreFn,
    SearchArgs,
    Task,
    add_generation,
    run_search,
    start_record,
)
from vsearch_jax.types import SearchResult, View
from vsearch_jax.xla.tree import tree_where


@flax.struct.dataclass
class _State:
    """State of the search.

    Attributes:
      record: what the search has found.
      num_wide: i32[], how often a wide sample became the best view.
    """

    record: Record
    num_wide: Array


def search(key: Array, score_fn: ScoreFn[Task], args: SearchArgs[Task], config: RandomSearchConfig) -> SearchResult:
    """Searches the view sphere for the view with the best score, by random samples around the best view so far.

    Samples are views from a normal distribution. An epoch takes the images of several samples. The standard deviation
    of azimuth and elevation is k (1 - c) rad. Here c is the best score so far, at least -1. So the samples spread
    further where the score is worse. Azimuth wraps. An elevation outside the band to search is reflected into the band.

    The last `config.num_wide` samples of an epoch are wide: they are uniform over the band. The thesis has none. They
    leave a local optimum with a high score, from which k (1 - c) is too small a step.

    The search ends at the threshold or after `config.max_epochs`. If the initial view meets the threshold, the search
    takes one image only.

    Args:
      key: PRNG key.
      score_fn: maps (view, args.task) to the score f32[]: cosine similarity to the target, or -inf where the arm cannot
        reach the view. `jax.vmap` is applied to it over the samples of an epoch.
      args: initial view, band, threshold and task of one search problem.
      config: settings of random search: k, samples and wide samples of an epoch, number of epochs.

    Returns:
      The best view, its score and the number of images taken; best_scores is f32[config.max_epochs].
    """
    return run_search(key, score_fn, args, method(config))


def method(config: RandomSearchConfig) -> Method[_State]:
    """Returns random search in parts (start, ask, tell, record), for a caller that takes the images itself."""
    return Method(
        start=lambda args, score: _State(start_record(args.initial, score, config.max_epochs), jnp.int32(0)),
        ask=functools.partial(_sample_views, config),
        tell=functools.partial(_update_state, config),
        record=lambda state: state.record,
        num_views=config.num_samples,
        counts=lambda state: {"num_wide": state.num_wide},
    )


def _sample_views(
    config: RandomSearchConfig, key: Array, args: SearchArgs[object], state: _State
) -> tuple[View, _State]:
    record = state.record
    narrow_key, wide_key = jax.random.split(jax.random.fold_in(key, record.generation))
    noise = jax.random.normal(narrow_key, (2, config.num_samples))
    sigma = config.k * (1.0 - jnp.maximum(record.score, -1.0))  # an unreachable initial view has the score -inf
    azimuth = wrap_angle(record.view.azimuth + sigma * noise[0])
    elevation = fold_into_band(record.view.elevation + sigma * noise[1], args.band)
    wide = view_from_uniform(jax.random.uniform(wide_key, (2, config.num_samples)), args.band)
    is_wide = jnp.arange(config.num_samples) >= config.num_samples - config.num_wide
    return tree_where(is_wide, wide, View(azimuth, elevation)), state


def _update_state(
    config: RandomSearchConfig, key: Array, args: SearchArgs[object], state: _State, views: View, scores: Array
) -> _State:
    del key
    record = add_generation(state.record, views, scores, args.threshold)
    is_wide = record.best >= config.num_samples - config.num_wide
    return _State(record, state.num_wide + is_wide.astype(jnp.int32))
