"""Random search around the best view so far (thesis 4.1)."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
from jax import Array

from vsearch_jax.config import RandomSearchConfig
from vsearch_jax.geometry import wrap_angle
from vsearch_jax.search.common import (
    Method,
    Record,
    ScoreFn,
    SearchArgs,
    Task,
    add_generation,
    fold_into_band,
    run_search,
    start_record,
)
from vsearch_jax.types import SearchResult, View


def search(key: Array, score_fn: ScoreFn[Task], args: SearchArgs[Task], config: RandomSearchConfig) -> SearchResult:
    """Searches the view sphere for the view with the best score, by random samples around the best view so far.

    Samples are views from a normal distribution. An epoch takes the images of several samples. The standard deviation
    of azimuth and elevation is k (1 - c) rad. Here c is the best score so far, at least -1. So the samples spread
    further where the score is worse. Azimuth wraps. An elevation outside the band to search is reflected into the band.
    The search ends at the threshold or after `config.max_epochs`. If the initial view meets the threshold, the search
    takes one image only.

    Args:
      key: PRNG key.
      score_fn: maps (view, args.task) to the score f32[]: cosine similarity to the target, or -inf where the arm cannot
        reach the view. `jax.vmap` is applied to it over the samples of an epoch.
      args: initial view, band, threshold and task of one search problem.
      config: settings of random search: k, samples of an epoch, number of epochs.

    Returns:
      The best view, its score and the number of images taken; best_scores is f32[config.max_epochs].
    """
    return run_search(key, score_fn, args, method(config))


def method(config: RandomSearchConfig) -> Method[Record]:
    """Returns random search in parts (start, ask, tell, record), for a caller that takes the images itself.

    The state of the search is the record of what the search has found.
    """
    return Method(
        start=lambda args, score: start_record(args.initial, score, config.max_epochs),
        ask=functools.partial(_sample_views, config),
        tell=lambda key, args, record, views, scores: add_generation(record, views, scores, args.threshold),
        record=lambda record: record,
        num_views=config.num_samples,
    )


def _sample_views(
    config: RandomSearchConfig, key: Array, args: SearchArgs[object], record: Record
) -> tuple[View, Record]:
    noise = jax.random.normal(jax.random.fold_in(key, record.generation), (2, config.num_samples))
    sigma = config.k * (1.0 - jnp.maximum(record.score, -1.0))  # an unreachable initial view has the score -inf
    views = View(
        azimuth=wrap_angle(record.view.azimuth + sigma * noise[0]),
        elevation=fold_into_band(record.view.elevation + sigma * noise[1], args.band),
    )
    return views, record
