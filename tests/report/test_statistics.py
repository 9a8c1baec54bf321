"""Intervals of rates and means: Wilson's, and those of the cluster bootstrap."""

import numpy as np
import pytest
import scipy.stats

from vsearch_jax.report.statistics import mean_interval, rate_interval


@pytest.mark.parametrize(
    ("successes", "total", "low", "high"),
    # Newcombe 1998, Statistics in Medicine 17, table I, method 3 (Wilson's score interval).
    [(81, 263, 0.2553, 0.3662), (15, 148, 0.0624, 0.1605), (0, 20, 0.0, 0.1611), (1, 29, 0.0061, 0.1718)],
)
def test_a_rate_of_independent_trials_has_wilsons_interval_or_a_little_more(successes, total, low, high) -> None:
    interval = rate_interval((np.arange(total) < successes)[:, None])
    assert low - 0.03 <= interval[0] <= low + 5e-5
    assert high - 5e-5 <= interval[1] <= high + 0.03


def test_equal_trials_have_wilsons_interval() -> None:
    assert rate_interval(np.zeros((4, 5), bool)) == pytest.approx([0.0, 0.1611], abs=5e-5)  # Newcombe, 0 of 20


def test_a_mean_of_independent_values_has_students_interval() -> None:
    values = np.random.default_rng(1).normal(3.0, 2.0, (400, 1))
    expected = scipy.stats.t.interval(0.95, 399, values.mean(), scipy.stats.sem(values[:, 0]))
    assert mean_interval(values) == pytest.approx(expected, abs=0.03)


@pytest.mark.parametrize(
    ("clusters", "members", "between", "within"),
    [
        (12, 10, 0.0, 1.0),  # initial views that do not matter
        (12, 10, 1.0, 0.0),  # only the initial view matters: 12 independent values
        (3, 300, 1.0, 0.3),  # policies that differ
        (3, 300, 0.0, 1.0),
        (2, 300, 1.0, 1.0),
        (1, 300, 0.0, 1.0),
    ],
)
def test_intervals_cover_the_true_mean(clusters: int, members: int, between: float, within: float) -> None:
    covered = []
    for seed in range(200):
        rng = np.random.default_rng(seed)
        values = between * rng.normal(size=(clusters, 1)) + within * rng.normal(size=(clusters, members))
        interval = mean_interval(values)
        assert interval is not None
        covered.append(interval[0] <= 0.0 <= interval[1])
    assert 0.87 <= np.mean(covered) <= 0.985  # the percentile bootstrap of 12 values covers about 91 %


def test_a_single_value_has_no_interval() -> None:
    assert mean_interval(np.ones((1, 1))) is None
