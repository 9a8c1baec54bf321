"""From the raw arrays of `evaluate` to the numbers of `results.json`."""

from __future__ import annotations

import importlib.metadata
import platform
from collections.abc import Mapping
from typing import Any

import jax
import numpy as np
import scipy.stats

from vsearch_jax.config import Config
from vsearch_jax.report.thesis import THESIS

SEARCHERS = {"random_search": "Random search", "cma_es": "CMA-ES", "sac": "Soft actor-critic"}
"""Keys of the searchers in `results.json`, and what people call them."""

_PACKAGES = ("vsearch_jax", "jax", "jaxlib", "flax", "optax", "brax", "evosax", "mujoco", "mujoco-mjx", "numpy")
_NUM_RESAMPLES = 2000


def results(arrays: Mapping[str, Any], config: Config, wall_seconds: Mapping[str, float]) -> dict[str, Any]:
    """Returns what `results.json` holds: plain values, units in the names.

    Rates have Wilson's 95 % interval under `..._ci95`, means a bootstrapped one (None for a single episode). For `sac`
    the top level pools the episodes of all seeds; `seeds` lists each.

    Args:
      arrays: what `evaluate` returned.
      config: the run's config.
      wall_seconds: wall time of each stage of the run.
    """
    searchers = {name: summarize(jax.tree.map(np.asarray, arrays[name])) for name in ("random_search", "cma_es")}
    policies = jax.tree.map(np.asarray, arrays["sac"])
    pooled = summarize(jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), policies))
    seeds = [
        {"seed": seed, **summarize(jax.tree.map(lambda x, s=seed: x[s], policies))}
        for seed in range(policies["is_success"].shape[0])
    ]
    pooled |= {"environment_steps": config.sac.num_environment_steps, "seeds": seeds}
    return {
        **searchers,
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


def summarize(trials: Mapping[str, Any]) -> dict[str, Any]:
    """Returns the measures of the thesis (3.6) over trials.

    Args:
      trials: arrays [N] of `evaluate` for one searcher.
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


def _rate(name: str, count: Any, total: Any) -> dict[str, Any]:
    """Returns a rate with Wilson's score interval (Wilson 1927)."""
    interval = scipy.stats.binomtest(int(count), int(total)).proportion_ci(0.95, method="wilson")
    return {name: int(count) / int(total), f"{name}_ci95": [float(interval.low), float(interval.high)]}


def _mean(name: str, values: np.ndarray) -> dict[str, Any]:
    """Returns a mean with the bootstrap's percentile interval; none where there is one value, no mean of NaN or inf."""
    values = np.asarray(values, np.float64)
    # An arm without speed limits has no times, a search that never got to a view no cosine.
    if not np.isfinite(values).all():
        return {name: None, f"{name}_ci95": None}
    interval = None
    if values.size > 1:
        # The same resamples in each run, so that the report of a run does not change when it is made again.
        found = scipy.stats.bootstrap(
            (values,), np.mean, n_resamples=_NUM_RESAMPLES, batch=100, method="percentile", rng=np.random.default_rng(0)
        ).confidence_interval
        interval = [float(found.low), float(found.high)]
    return {name: float(values.mean()), f"{name}_ci95": interval}
