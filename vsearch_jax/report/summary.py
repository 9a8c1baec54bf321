"""Turns the arrays of `evaluate` into the numbers of `results.json`."""

from __future__ import annotations

import importlib.metadata
import platform
from collections.abc import Callable, Mapping
from typing import Any, TypeAlias

import jax
import numpy as np
import scipy.stats

from vsearch_jax.config import Config
from vsearch_jax.evaluation import Outcome
from vsearch_jax.report.thesis import THESIS
from vsearch_jax.types import View

SEARCHERS = {"random_search": "Random search", "cma_es": "CMA-ES", "sac": "Soft actor-critic"}
"""Display name of each searcher, by its key in `results.json`."""

Results: TypeAlias = dict[str, Any]  # nested JSON: its type depends on the key
"""Content of `results.json`: plain values; the keys hold the units."""

Trials: TypeAlias = Mapping[str, np.ndarray]
"""Measures of one searcher, by name: arrays of [trials] or [seeds, episodes]."""

_PACKAGES = ("vsearch_jax", "jax", "jaxlib", "flax", "optax", "brax", "evosax", "mujoco", "mujoco-mjx", "numpy")
_NUM_RESAMPLES = 2000


def summarize_results(arrays: Mapping[str, Outcome], config: Config, wall_seconds: Mapping[str, float]) -> Results:
    """Computes the content of `results.json`: rates and means of the measures of each searcher, versions, machine.

    A rate has Wilson's 95 % interval, a mean has a bootstrap 95 % interval. The keys of intervals end in `_ci95`. The
    interval of a mean is None for a single trial. For `sac` the top level pools the episodes of all policy seeds, and
    `seeds` lists each seed.

    Args:
      arrays: measures of each searcher, from `evaluate`.
      config: the run's config.
      wall_seconds: wall time in s of each stage of the run.
    """
    trials = {name: to_trials(outcome) for name, outcome in arrays.items()}
    policies = trials["sac"]
    pooled = summarize_trials(_map_arrays(lambda x: x.reshape(-1, *x.shape[2:]), policies))
    seeds = [
        {"seed": seed, **summarize_trials(_map_arrays(lambda x, s=seed: x[s], policies))}
        for seed in range(policies["is_success"].shape[0])
    ]
    pooled |= {"environment_steps": config.sac.num_environment_steps, "seeds": seeds}
    return {
        "random_search": summarize_trials(trials["random_search"]),
        "cma_es": summarize_trials(trials["cma_es"]),
        "sac": pooled,
        "reachable": config.env.reachable,
        "motion": config.env.motion,
        "thesis": THESIS,
        "versions": {name: importlib.metadata.version(name) for name in _PACKAGES},
        "machine": {
            "platform": platform.platform(),
            "python": platform.python_version(),
            "device": jax.devices()[0].device_kind,
            "num_devices": jax.device_count(),
        },
        "wall_seconds": dict(wall_seconds),
    }


def to_trials(outcome: Outcome) -> Trials:
    """Converts the measures of one searcher from JAX to numpy arrays by name. Initial and target views are left out."""
    return {name: np.asarray(array) for name, array in outcome.items() if not isinstance(array, View)}


def summarize_trials(trials: Trials) -> Results:
    """Computes rates, means and percentiles over all trials (searches) of one searcher, as in thesis 3.6.

    Args:
      trials: measures of one searcher by name, arrays with one entry for each trial.

    Returns:
      The part of `results.json` for this searcher.
    """
    rotation = np.rad2deg(trials["rotation_error"])
    evaluations = trials["evaluations"]
    summary = {
        **_rate("success_rate", trials["is_success"].sum(), evaluations.size),
        "episodes": int(evaluations.size),
        **_mean("evaluations_mean", evaluations),
        "evaluations_p99": float(np.percentile(evaluations, 99)),
        **_mean("final_cosine_mean", trials["final_cosine"]),
        **_mean("rotation_error_deg_mean", rotation),
        "rotation_error_deg_median": float(np.median(rotation)),
        **_mean("frobenius_angle_deg_mean", np.rad2deg(trials["frobenius_angle"])),
        **_mean("translation_error_cm_mean", 100.0 * trials["translation_error"]),
        **_rate("false_positive_rate", trials["is_false_positive"].sum(), evaluations.size),
        **_mean("joint_travel_rad_mean", trials["joint_travel"]),
        **_mean("motion_time_s_mean", trials["motion_time"]),
        **_mean("plans_mean", trials["num_plans"]),
        **_rate("unreachable_rate", trials["unreachable"].sum(), evaluations.sum()),
    }
    if "steps_lower_bound" in trials:
        bound = trials["steps_lower_bound"]
        summary |= _mean("steps_lower_bound_mean", bound)
        summary["evaluations_over_lower_bound"] = float(evaluations.mean() / bound.mean())
        is_helped = trials["num_helped"] > 0
        summary |= _rate("helped_rate", is_helped.sum(), evaluations.size)
        summary |= _rate("unaided_success_rate", (trials["is_success"] & ~is_helped).sum(), evaluations.size)
    return summary


def _map_arrays(function: Callable[[np.ndarray], np.ndarray], trials: Trials) -> Trials:
    return {name: function(array) for name, array in trials.items()}


def _rate(name: str, count: int | np.integer, total: int | np.integer) -> Results:
    """Returns a rate with Wilson's score interval (Wilson 1927)."""
    interval = scipy.stats.binomtest(int(count), int(total)).proportion_ci(0.95, method="wilson")
    return {name: int(count) / int(total), f"{name}_ci95": [float(interval.low), float(interval.high)]}


def _mean(name: str, values: np.ndarray) -> Results:
    """Returns a mean with its bootstrap percentile interval.

    The interval is None for a single value. Both are None where a value is NaN or infinite.
    """
    values = np.asarray(values, np.float64)
    # An arm without speed limits has no motion times. A search that reached no view has no cosine.
    if not np.isfinite(values).all():
        return {name: None, f"{name}_ci95": None}
    interval = None
    if values.size > 1:
        # A fixed seed, so that two reports of one run are equal.
        found = scipy.stats.bootstrap(
            (values,), np.mean, n_resamples=_NUM_RESAMPLES, batch=100, method="percentile", rng=np.random.default_rng(0)
        ).confidence_interval
        interval = [float(found.low), float(found.high)]
    return {name: float(values.mean()), f"{name}_ci95": interval}
