"""The figures of a run, each a function from arrays to a matplotlib figure, the thesis's values drawn beside ours."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from vsearch_jax.config import Config
from vsearch_jax.report.style import COLORS, INK, REACHABLE, THESIS_COLOR, UNREACHABLE, styled
from vsearch_jax.report.summary import SEARCHERS
from vsearch_jax.report.thesis import THESIS
from vsearch_jax.types import ReachabilityMap

THESIS_BAND_DEG = (40, 70)
"""Elevations that the thesis's arm reached at every azimuth."""


@styled
def reachability(reach: ReachabilityMap, wanted_deg: tuple[float, float] | None = None) -> Figure:
    """Draws which views the arm can reach, and the band that it reaches at every azimuth.

    Args:
      reach: the map.
      wanted_deg: lowest and highest elevation that are wanted, in degrees; the thesis's band by default.
    """
    azimuths, elevations = np.rad2deg(reach.azimuths), np.rad2deg(reach.elevations)
    figure = Figure(figsize=(8, 3.6))
    axes = figure.add_subplot()
    # A cell is centred on its view.
    half = 0.5 * np.array([360.0 / len(azimuths), elevations[1] - elevations[0]])
    extent = (azimuths[0] - half[0], azimuths[-1] + half[0], elevations[0] - half[1], elevations[-1] + half[1])
    axes.imshow(
        np.asarray(reach.is_reachable).T,
        origin="lower",
        extent=extent,
        aspect="auto",
        cmap=ListedColormap([UNREACHABLE, REACHABLE]),
        vmin=0,
        vmax=1,
    )
    axes.grid(False)
    low, high = np.rad2deg(reach.band)
    ends = axes.get_xlim()
    ours = axes.hlines([low, high], *ends, color=COLORS["sac"])
    name, lines = ("thesis", THESIS_BAND_DEG) if wanted_deg is None else ("wanted", wanted_deg)
    other = axes.hlines(lines, *ends, color=INK, linestyle="--", linewidth=1)
    axes.set(
        xlabel="azimuth (°)", ylabel="elevation (°)", title="Views that the arm can reach", xticks=range(0, 361, 45)
    )
    axes.set_xlim(ends)
    handles = [Patch(color=REACHABLE), Patch(color=UNREACHABLE), ours, other]
    band = "none" if np.isnan(low) else f"{low:.0f}–{high:.0f}°"
    labels = ["reachable", "not reachable", f"at every azimuth: {band}", f"{name}: {lines[0]:g}–{lines[1]:g}°"]
    figure.legend(handles, labels, loc="outside lower center", ncols=4)
    return figure


@styled
def mount_heights(heights: Sequence[float], coverages: Sequence[float], best: float) -> Figure:
    """Draws the share of the wanted views that the arm reaches, against the height (m) of its mount."""
    figure = Figure(figsize=(6, 3.2))
    axes = figure.add_subplot()
    axes.plot(heights, 100.0 * np.asarray(coverages), marker="o", markersize=3)
    axes.axvline(best, linestyle=":", color="black")
    axes.set(xlabel="mount height (m)", ylabel="wanted views in reach (%)", ylim=(-3, 103))
    axes.set_title(f"Best mount height: {best:.2f} m")
    return figure


@styled
def training(lines: Sequence[Mapping[str, Any]], config: Config) -> Figure:
    """Draws losses, reward, success and temperature over training.

    Args:
      lines: the lines of metrics.jsonl.
      config: the run's config.
    """
    figure = Figure(figsize=(10, 5.6))
    panels = figure.subplots(2, 3)
    policy = [("reward", "reward of a step"), ("success_rate", "success of ended episodes")]
    policy += [("critic_loss", "critic loss"), ("actor_loss", "actor loss"), ("alpha", "temperature α")]
    _curve(panels.flat[0], lines, "encoder_loss", config, COLORS["cma_es"])
    panels.flat[0].set(xlabel="encoder updates", ylabel="bootstrapped L2 loss", yscale="log")
    for axes, (name, label) in zip(panels.flat[1:], policy, strict=True):
        _curve(axes, lines, name, config, COLORS["sac"])
        axes.set(xlabel="environment steps of a policy", ylabel=label)
    figure.suptitle("Training: each iteration and its running mean", x=0.01, ha="left")
    return figure


def _curve(axes: Axes, lines: Sequence[Mapping[str, Any]], name: str, config: Config, color: str) -> None:
    points = [(line["iteration"], line[name]) for line in lines if name in line]
    if not points:
        return
    iterations, values = np.array(points).T
    if name != "encoder_loss":
        iterations = (iterations - config.encoder.num_updates + 1) * config.sac.num_envs
    width = max(1, len(values) // 40)
    axes.plot(iterations, values, color=color, alpha=0.25, linewidth=0.8)
    smooth = np.convolve(values, np.ones(width) / width, mode="valid")
    axes.plot(iterations[width - 1 :], smooth, color=color)


@styled
def search_progress(name: str, trials: Mapping[str, Any], samples: int, threshold: float) -> Figure:
    """Draws the best cosine so far over images taken, of every trial, and how many trials have ended.

    Args:
      name: random_search or cma_es.
      trials: arrays [N] of `evaluate`.
      samples: images of a generation.
      threshold: cosine at which a search ends.
    """
    best = np.asarray(trials["best_scores"])
    evaluations = np.asarray(trials["evaluations"])
    is_success = np.asarray(trials["is_success"])
    figure = Figure(figsize=(8, 4.6))
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=(3, 1))
    images = 1 + samples * np.arange(1, best.shape[1] + 1)  # the first is that of the initial view
    for scores, count in zip(best, evaluations, strict=True):
        end = int(np.ceil((count - 1) / samples))
        upper.plot(images[:end], scores[:end], color=COLORS[name], alpha=0.2, linewidth=0.9)
    upper.plot(images, np.median(best, axis=0), color=INK, label="median")
    upper.axhline(threshold, color=INK, linestyle=":", linewidth=1.2, label=f"threshold {threshold:g}")
    low, high = THESIS[name]["evaluations_mean"]
    for axes in (upper, lower):
        axes.axvspan(low, high, color=THESIS_COLOR, alpha=0.25, linewidth=0, label=f"thesis: {low}–{high} images, mean")
    mean = evaluations.mean()
    upper.axvline(mean, color=COLORS[name], linestyle="--", label=f"ours: {mean:.1f} images, mean")
    upper.set(ylabel="best cosine so far", title=f"{SEARCHERS[name]}: {len(best)} trials")
    upper.legend(loc="lower right")
    ends = np.sort(evaluations[is_success])
    share = 100.0 * np.arange(1, len(ends) + 1) / len(best)
    lower.step([0, *ends, images[-1]], [0, *share, share[-1] if len(share) else 0], where="post", color=COLORS[name])
    lower.axhline(100 * THESIS[name]["success_rate"], color=THESIS_COLOR, linestyle="--", linewidth=1.2)
    lower.set(xlabel="images taken", ylabel="found (%)", ylim=(0, 105), xlim=(0, images[-1]))
    return figure


@styled
def policy_episodes(trials: Mapping[str, Any]) -> Figure:
    """Draws the evaluation of the policies: steps beside their lower bound, and pose errors.

    Args:
      trials: arrays [S, N] of `evaluate`, all seeds.
    """
    steps = np.asarray(trials["evaluations"]).ravel()
    bound = np.asarray(trials["steps_lower_bound"]).ravel()
    figure = Figure(figsize=(10, 3.6))
    counts, rotation, translation = figure.subplots(1, 3, width_ratios=(1.6, 1, 1))
    numbers = np.arange(1, max(steps.max(), bound.max()) + 1)
    share = [100.0 * np.bincount(x, minlength=numbers[-1] + 1)[1:] / x.size for x in (steps, bound)]
    counts.bar(numbers - 0.2, share[0], 0.4, color=COLORS["sac"], label=f"ours, mean {steps.mean():.2f}")
    counts.bar(numbers + 0.2, share[1], 0.4, color="#b9d8cd", label=f"fewest possible, mean {bound.mean():.2f}")
    counts.axvline(THESIS["sac"]["evaluations_mean"], color=THESIS_COLOR, linestyle="--", label="thesis, mean 4")
    counts.set(
        xlabel="steps of an episode", ylabel="episodes (%)", title=f"{steps.size} episodes, views and targets random"
    )
    counts.legend(loc="upper right")
    errors = {
        rotation: ("rotational error (°)", np.rad2deg(trials["rotation_error"]), "rotation_error_deg_mean", "°"),
        translation: (
            "translational error (cm)",
            100 * trials["translation_error"],
            "translation_error_cm_mean",
            " cm",
        ),
    }
    for axes, (label, values, key, unit) in errors.items():
        values = np.asarray(values).ravel()
        shown = np.clip(values, 0, np.percentile(values, 99))  # the last bar holds the rest
        axes.hist(shown, 30, color=COLORS["sac"], weights=np.full(values.size, 100.0 / values.size))
        axes.axvline(np.median(values), color=INK, linewidth=1.2, label=f"median {np.median(values):.2f}{unit}")
        thesis = THESIS["sac"][key]
        axes.axvline(thesis, color=THESIS_COLOR, linestyle="--", label=f"thesis, mean {thesis}{unit}")
        axes.set(xlabel=label, ylabel="episodes (%)")
        axes.legend(loc="upper right")
    return figure


@styled
def comparison(results: Mapping[str, Any]) -> Figure:
    """Draws ours beside the thesis's for every searcher: success, images, rotation, translation.

    Args:
      results: what `results.json` holds.
    """
    panels = {
        "success_rate": ("success (%)", 100.0),
        "evaluations_mean": ("images or steps, mean", 1.0),
        "rotation_error_deg_mean": ("rotational error, mean (°)", 1.0),
        "translation_error_cm_mean": ("translational error, mean (cm)", 1.0),
    }
    figure = Figure(figsize=(11, 3.4))
    for axes, (key, (label, scale)) in zip(figure.subplots(1, len(panels)), panels.items(), strict=True):
        for place, name in enumerate(SEARCHERS):
            ours, interval = scale * results[name][key], results[name][f"{key}_ci95"]
            axes.bar(place - 0.2, ours, 0.38, color=COLORS[name])
            if interval is not None:
                _whisker(axes, place - 0.2, scale * np.array(interval))
            ends = scale * np.atleast_1d(THESIS[name][key])
            axes.bar(place + 0.2, ends.mean(), 0.38, color=THESIS_COLOR, alpha=0.5, hatch="///", edgecolor="white")
            if len(ends) > 1:
                _whisker(axes, place + 0.2, ends)
        axes.set_xticks(range(len(SEARCHERS)), ["random", "CMA-ES", "SAC"])
        axes.set(title=label)
        axes.grid(axis="x", visible=False)
    figure.supxlabel(
        "coloured: ours with 95 % intervals; hatched: thesis, with its range where it gives one", fontsize=9
    )
    return figure


def _whisker(axes: Axes, place: float, ends: np.ndarray) -> None:
    axes.plot([place, place], ends, color=INK, linewidth=1.2)


@styled
def search_strip(images: np.ndarray, cosines: Sequence[float], target: np.ndarray) -> Figure:
    """Draws what the camera saw at each step of a search, its cosine below, and the target image at the end.

    Eight pictures stand in a row.

    Args:
      images: f32[N, H, W, 3] in [0, 1].
      cosines: N cosine similarities with the target.
      target: f32[H, W, 3] in [0, 1].
    """
    count = len(images) + 1
    columns, rows = min(count, 8), -(-count // 8)
    figure = Figure(figsize=(1.6 * columns, 2.1 * rows))
    captions = [f"step {step}: {cosine:.3f}" if step else f"start: {cosine:.3f}" for step, cosine in enumerate(cosines)]
    grid = figure.subplots(rows, columns, squeeze=False).reshape(-1)
    for axes in grid[count:]:
        axes.set_visible(False)
    for axes, image, caption in zip(grid[:count], [*images, target], [*captions, "target"], strict=True):
        axes.imshow(np.clip(image, 0, 1))
        axes.set_xlabel(caption)
        axes.set(xticks=[], yticks=[])
        axes.grid(False)
        axes.spines[:].set_visible(True)
        axes.spines[:].set_color(COLORS["sac"] if caption == "target" else "#c9ced6")
    return figure
