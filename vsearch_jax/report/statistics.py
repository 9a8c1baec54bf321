"""Rates and means with 95 % intervals that count trials of one cluster as related.

Trials that start at the same initial view, and episodes of the same policy, resemble one another. Intervals that take
all trials as independent are too narrow.
"""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
import scipy.stats

Interval: TypeAlias = list[float]
"""Lower and upper end."""

_NUM_RESAMPLES = 2000
_BATCH = 100
"""Number of resamples that are in memory at once."""


def bootstrap_means(values: np.ndarray) -> np.ndarray:
    """Resamples clusters, then the members of each, and returns the means f64[2000] of the resamples.

    This is the two-stage cluster bootstrap (Davison and Hinkley 1997, section 3.8). The seed is fixed, so equal values
    give equal means.

    Args:
      values: f64[C, M], M values of each of C clusters. With one cluster only its members are resampled.
    """
    rng = np.random.default_rng(0)
    clusters, members = values.shape
    means = []
    for _ in range(_NUM_RESAMPLES // _BATCH):
        cluster = rng.integers(clusters, size=(_BATCH, clusters, 1))
        member = rng.integers(members, size=(_BATCH, clusters, members))
        means.append(values[cluster, member].mean(axis=(1, 2)))
    return np.concatenate(means)


def mean_interval(values: np.ndarray) -> Interval | None:
    """Returns the 95 % interval of a mean by the cluster bootstrap, or None for a single value.

    Args:
      values: f64[C, M], M values of each of C clusters.
    """
    if values.size < 2:
        return None
    low, high = np.percentile(bootstrap_means(values), [2.5, 97.5])
    return [float(low), float(high)]


def rate_interval(is_true: np.ndarray) -> Interval:
    """Returns the 95 % interval of a rate: the union of Wilson's interval and that of the cluster bootstrap.

    Wilson's interval (Wilson 1927) takes the trials as independent. The bootstrap's has no width where all trials are
    equal.

    Args:
      is_true: bool[C, M], M trials of each of C clusters.
    """
    wilson = scipy.stats.binomtest(int(is_true.sum()), is_true.size).proportion_ci(0.95, method="wilson")
    low, high = np.percentile(bootstrap_means(is_true.astype(np.float64)), [2.5, 97.5])
    return [float(min(low, wilson.low)), float(max(high, wilson.high))]
