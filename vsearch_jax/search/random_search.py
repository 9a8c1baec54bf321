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
    add_generation,
    fold_into_band,
    run_search,
    start_record,
)
from vsearch_jax.types import SearchResult, View


def search(key: Array, score_fn: ScoreFn, args: SearchArgs, config: RandomSearchConfig) -> SearchResult:
    """Searches the view sphere by normal samples around the best view, wider the worse its score.

    The standard deviation of azimuth and elevation is k (1 - c) rad, c the best score so far (-1 at the least). Azimuth
    wraps; an elevation outside the band is reflected into it. The search ends at the threshold or after
    `config.max_epochs`; if the initial view meets the threshold, after its one image.

    Args:
      key: PRNG key.
      score_fn: maps (view, args.task) to the score, f32[]; -inf where unreachable. It is vmapped over the samples.
      args: SearchArgs of one problem.
      config: RandomSearchConfig.

    Returns:
      SearchResult with best_scores f32[config.max_epochs].
    """
    return run_search(key, score_fn, args, method(config))


def method(config: RandomSearchConfig) -> Method:
    """Returns the searcher's parts; its state is the record."""
    return Method(
        start=lambda args, score: start_record(args.initial, score, config.max_epochs),
        ask=functools.partial(_ask, config),
        tell=lambda key, args, record, views, scores: add_generation(record, views, scores, args.threshold),
        record=lambda record: record,
        num_views=config.num_samples,
    )


def _ask(config: RandomSearchConfig, key: Array, args: SearchArgs, record: Record) -> tuple[View, Record]:
    noise = jax.random.normal(jax.random.fold_in(key, record.generation), (2, config.num_samples))
    sigma = config.k * (1.0 - jnp.maximum(record.score, -1.0))  # -1 stands in for the -inf of an unreachable start
    views = View(
        azimuth=wrap_angle(record.view.azimuth + sigma * noise[0]),
        elevation=fold_into_band(record.view.elevation + sigma * noise[1], args.band),
    )
    return views, record
