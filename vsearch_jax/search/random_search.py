"""Random search around the best view so far (thesis 4.1)."""

from __future__ import annotations

import functools

import jax
from jax import Array

from vsearch_jax.config import RandomSearchConfig
from vsearch_jax.search.common import (
    Record,
    ScoreFn,
    SearchArgs,
    add_generation,
    initial_score,
    is_running,
    sample_around_best,
    start_record,
    to_result,
)
from vsearch_jax.types import SearchResult


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
    record = start_record(args.initial, initial_score(score_fn, args), config.max_epochs)
    body = functools.partial(_epoch, key, score_fn, args, config)
    record = jax.lax.while_loop(lambda record: is_running(record, args.threshold), body, record)
    return to_result(record)


def _epoch(key: Array, score_fn: ScoreFn, args: SearchArgs, config: RandomSearchConfig, record: Record) -> Record:
    views = sample_around_best(
        jax.random.fold_in(key, record.generation), record, args.band, config.k, config.num_samples
    )
    scores = jax.vmap(score_fn, in_axes=(0, None))(views, args.task)
    return add_generation(record, views, scores, args.threshold)
