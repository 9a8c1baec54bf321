"""Turns the arrays of `evaluate` into the numbers of `results.json`."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, TypeAlias

import numpy as np

from vsearch_jax.config import Config
from vsearch_jax.evaluation import FALSE_POSITIVE_DEG, Outcome
from vsearch_jax.report.provenance import provenance
from vsearch_jax.report.statistics import mean_interval, rate_interval
from vsearch_jax.report.thesis import THESIS
from vsearch_jax.search import BLACK_BOX, LABELS, POLICIES
from vsearch_jax.types import View

Results: TypeAlias = dict[str, Any]  # nested JSON: its type depends on the key
"""Content of `results.json`: plain values; the keys hold the units."""

Trials: TypeAlias = Mapping[str, np.ndarray]
"""Measures of one searcher, by name: arrays of [clusters, members], for example [policy seeds, episodes]."""

POSE_SUCCESS_DEG = (FALSE_POSITIVE_DEG, 5.0)
"""Largest rotation errors of a pose success, by `pose_success_rate` and `pose_success_5deg_rate`."""
MAX_FALSE_POSITIVE_RATE = 0.01
"""Above this rate the report warns."""


def summarize_results(arrays: Mapping[str, Outcome], config: Config, wall_seconds: Mapping[str, float]) -> Results:
    """Computes the content of `results.json`: rates and means of each searcher's measures, config, versions, machine.

    Rates and means have 95 % intervals; their keys end in `_ci95`. The intervals count the trials of one initial view,
    and the episodes of one policy, as related; see `statistics`. The interval of a mean is None for a single trial. A
    policy's entry pools the episodes of all policy seeds, and its `seeds` lists each seed.

    Args:
      arrays: measures of each searcher, from `evaluate`.
      config: the run's config.
      wall_seconds: wall time in s of each stage of the run.
    """
    num_views = config.evaluation.num_initial_views
    results: Results = {}
    for name in BLACK_BOX:
        by_view = _map_arrays(lambda x: x.reshape(num_views, -1, *x.shape[1:]), to_trials(arrays[name]))
        results[name] = summarize_trials(by_view)
    for name in POLICIES:
        results[name] = _summarize_policies(to_trials(arrays[name]), config)
    return results | {
        "reachable": config.env.reachable,
        "motion": config.env.motion,
        "thesis": THESIS,
        "config": config.to_dict(),
        "wall_seconds": dict(wall_seconds),
        **provenance(),
    }


def _summarize_policies(trials: Trials, config: Config) -> Results:
    """Returns the part of `results.json` for a search by policies; `trials` has arrays of [policy seeds, episodes]."""
    seeds = [
        {"seed": seed, **summarize_trials(_map_arrays(lambda x, s=seed: x[s][:, None], trials))}
        for seed in range(trials["is_success"].shape[0])
    ]
    training = {"environment_steps": config.sac.num_environment_steps, "images_rendered": _num_images(config)}
    return summarize_trials(trials) | training | {"seeds": seeds}


def _num_images(config: Config) -> int:
    """Returns the number of images that the training of encoder and policies renders."""
    encoder, sac = config.encoder, config.sac
    per_example = 1 if encoder.loss == "pose" else 2  # the decoder's target is an image of its own
    examples = encoder.num_updates * encoder.batch_size
    return per_example * examples + encoder.pool_size + sac.num_seeds * sac.num_environment_steps


def false_positive_warning(results: Results) -> str | None:
    """Returns a sentence that says which searchers find wrong views, and what to do; None if all are reliable.

    Args:
      results: content of `results.json`.
    """
    rates = {LABELS[name]: results[name]["false_positive_rate"] for name in LABELS}
    bad = [f"{label} {100 * rate:.1f} %" for label, rate in rates.items() if rate > MAX_FALSE_POSITIVE_RATE]
    if not bad:
        return None
    encoder = results["config"]["encoder"]
    more = f"--encoder.num-updates above {encoder['num_updates']}"
    return (
        f"Wrong views were found: more than {FALSE_POSITIVE_DEG:g}° from the target although the cosine meets the "
        f"threshold ({', '.join(bad)} of the searches). The encoder does not tell these views apart. Train with "
        f"{more if encoder['loss'] == 'pose' else '--encoder.loss pose'}. If the object looks the same after a turn "
        "about the vertical, declare it with --scene.symmetry N (N equal turns; 0: any turn)."
    )


def to_trials(outcome: Outcome) -> Trials:
    """Converts the measures of one searcher from JAX to numpy arrays by name. Initial and target views are left out."""
    return {name: np.asarray(array) for name, array in outcome.items() if not isinstance(array, View)}


def summarize_trials(trials: Trials) -> Results:
    """Computes rates, means and percentiles over all trials (searches) of one searcher, as in thesis 3.6.

    Args:
      trials: measures of one searcher by name, arrays of [clusters, members]: one entry for each trial.

    Returns:
      The part of `results.json` for this searcher.
    """
    rotation = np.rad2deg(trials["rotation_error"])
    is_success, evaluations = trials["is_success"], trials["evaluations"]
    wide, narrow = (is_success & (rotation <= degrees) for degrees in POSE_SUCCESS_DEG)
    summary = {
        **_rate("success_rate", is_success),
        **_rate("pose_success_rate", wide),
        **_rate("pose_success_5deg_rate", narrow),
        "episodes": int(evaluations.size),
        **_mean("evaluations_mean", evaluations),
        "evaluations_p99": float(np.percentile(evaluations, 99)),
        **_mean("final_cosine_mean", trials["final_cosine"]),
        **_mean("rotation_error_deg_mean", rotation),
        "rotation_error_deg_median": float(np.median(rotation)),
        **_mean("frobenius_angle_deg_mean", np.rad2deg(trials["frobenius_angle"])),
        **_mean("translation_error_cm_mean", 100.0 * trials["translation_error"]),
        **_mean("mssd_cm_mean", 100.0 * trials["surface_distance"]),
        **_rate("false_positive_rate", trials["is_false_positive"]),
        **_mean("joint_travel_rad_mean", trials["joint_travel"]),
        **_mean("motion_time_s_mean", trials["motion_time"]),
        **_mean("plans_mean", trials["num_plans"]),
        "unreachable_rate": float(trials["unreachable"].sum() / evaluations.sum()),
    }
    if "num_wide" in trials:
        summary |= _rate("wide_rate", trials["num_wide"] > 0)
    if "num_restarts" in trials:
        summary |= _mean("restarts_mean", trials["num_restarts"])
        summary |= _mean("scan_images_mean", trials["scan_images"])
    if "steps_lower_bound" in trials:
        bound = trials["steps_lower_bound"]
        summary |= _mean("steps_lower_bound_mean", bound)
        summary["evaluations_over_lower_bound"] = float(evaluations.mean() / bound.mean())
        summary |= _rate("below_bound_rate", is_success & (evaluations < bound))
    if "num_helped" in trials:
        summary |= _rate("helped_rate", trials["num_helped"] > 0)
    return summary


def _map_arrays(function: Callable[[np.ndarray], np.ndarray], trials: Trials) -> Trials:
    return {name: function(array) for name, array in trials.items()}


def _rate(name: str, is_true: np.ndarray) -> Results:
    return {name: float(is_true.mean()), f"{name}_ci95": rate_interval(is_true)}


def _mean(name: str, values: np.ndarray) -> Results:
    """Returns a mean with its interval. Both are None where a value is NaN or infinite."""
    values = np.asarray(values, np.float64)
    # An arm without speed limits has no motion times. A search that reached no view has no cosine.
    if not np.isfinite(values).all():
        return {name: None, f"{name}_ci95": None}
    return {name: float(values.mean()), f"{name}_ci95": mean_interval(values)}
