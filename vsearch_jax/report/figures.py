"""Figures of a run: functions from arrays to matplotlib figures, with the thesis's values beside ours."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from vsearch_jax.config import Config
from vsearch_jax.report.style import COLORS, INK, REACHABLE, THESIS_COLOR, UNREACHABLE, styled
from vsearch_jax.report.summary import Results, Trials
from vsearch_jax.report.thesis import thesis_range
from vsearch_jax.search import LABELS
from vsearch_jax.types import ReachabilityMap

THESIS_BAND_DEG = (40, 70)
"""Elevations in degrees that the thesis's arm reached at every azimuth."""

_ENCODER_PANELS = {
    "encoder_loss": "encoder loss",
    "false_match_rate": "share of matches > 10° off",
    "threshold_angle_deg": "angle at the threshold (°)",
}
_POLICY_PANELS = {
    "reward": "reward of a step",
    "pose_success_rate": "pose success of ended episodes",
    "critic_loss": "critic loss",
    "actor_loss": "actor loss",
    "alpha": "temperature α",
}


@styled
def draw_reachability(reach: ReachabilityMap, wanted_deg: tuple[float, float] | None = None) -> Figure:
    """Draws a map of the views that the arm reaches, and the range of elevations that it reaches at every azimuth.

    Args:
      reach: the views that the arm reaches.
      wanted_deg: lowest and highest wanted elevation in degrees; the thesis's band by default.
    """
    azimuths, elevations = np.rad2deg(reach.azimuths), np.rad2deg(reach.elevations)
    figure = Figure(figsize=(8, 3.6))
    axes = figure.add_subplot()
    # A view is the centre of its cell.
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
def draw_mount_heights(heights: Sequence[float], coverages: Sequence[float], best: float) -> Figure:
    """Draws the share of the wanted views that the arm reaches, for several heights of the arm's mount.

    Args:
      heights: mount heights in m.
      coverages: for each height, the share of the wanted views that the arm reaches, in [0, 1].
      best: best mount height in m; it is marked.
    """
    figure = Figure(figsize=(6, 3.2))
    axes = figure.add_subplot()
    axes.plot(heights, 100.0 * np.asarray(coverages), marker="o", markersize=3)
    axes.axvline(best, linestyle=":", color="black")
    axes.set(xlabel="mount height (m)", ylabel="reachable wanted views (%)", ylim=(-3, 103))
    axes.set_title(f"Best mount height: {best:.10g} m")
    return figure


@styled
def draw_training(lines: Sequence[Mapping[str, float | str]], config: Config) -> Figure:
    """Draws how losses, reward, success rate and temperature change over the training.

    Args:
      lines: lines of metrics.jsonl, one for each iteration.
      config: the run's config.
    """
    figure = Figure(figsize=(13, 5.6))
    panels = figure.subplots(2, 4)
    for axes, (name, label) in zip(panels.flat[:3], _ENCODER_PANELS.items(), strict=True):
        _plot_metric(axes, lines, name, config, COLORS["cma_es"])
        axes.set(xlabel="encoder updates", ylabel=label)
    panels.flat[0].set(yscale="log")
    for axes, (name, label) in zip(panels.flat[3:], _POLICY_PANELS.items(), strict=True):
        _plot_metric(axes, lines, name, config, COLORS["sac"])
        axes.set(xlabel="environment steps of a policy", ylabel=label)
    figure.suptitle("Training: values of each iteration, and their running mean", x=0.01, ha="left")
    return figure


def _plot_metric(axes: Axes, lines: Sequence[Mapping[str, float | str]], name: str, config: Config, color: str) -> None:
    """Plots metric `name` and its running mean. Plots nothing if no line holds it."""
    points = [(line["iteration"], line[name]) for line in lines if name in line]
    if not points:
        return
    iterations, values = np.array(points).T
    if name not in _ENCODER_PANELS:
        iterations = (iterations - config.encoder.num_updates + 1) * config.sac.num_envs
    width = max(1, len(values) // 40)
    axes.plot(iterations, values, color=color, alpha=0.25, linewidth=0.8)
    smooth = np.convolve(values, np.ones(width) / width, mode="valid")
    axes.plot(iterations[width - 1 :], smooth, color=color)


@styled
def draw_search_progress(name: str, trials: Trials, num_samples: int, threshold: float) -> Figure:
    """Draws a searcher's progress over the number of images: best cosine of each trial, share of successful trials.

    Args:
      name: the searcher, a key of `vsearch_jax.search.BLACK_BOX`.
      trials: measures of this searcher from `evaluate`, arrays with one entry for each of N trials (searches).
      num_samples: number of images of a generation (images that the searcher asks for at once).
      threshold: cosine at which a search ends.
    """
    best, evaluations = trials["best_scores"], trials["evaluations"]
    figure = Figure(figsize=(8, 4.6))
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=(3, 1))
    images = 1 + num_samples * np.arange(1, best.shape[1] + 1)  # the initial view is one image
    for scores, count in zip(best, evaluations, strict=True):
        end = int(np.ceil((count - 1) / num_samples))
        upper.plot(images[:end], scores[:end], color=COLORS[name], alpha=0.2, linewidth=0.9)
    upper.plot(images, np.median(best, axis=0), color=INK, label="median")
    upper.axhline(threshold, color=INK, linestyle=":", linewidth=1.2, label=f"threshold {threshold:g}")
    if (of_thesis := thesis_range(name, "evaluations_mean")) is not None:
        label = f"thesis: {of_thesis[0]:g}–{of_thesis[1]:g} images, mean"
        for axes in (upper, lower):
            axes.axvspan(*of_thesis, color=THESIS_COLOR, alpha=0.25, linewidth=0, label=label)
    mean = evaluations.mean()
    upper.axvline(mean, color=COLORS[name], linestyle="--", label=f"ours: {mean:.1f} images, mean")
    upper.set(ylabel="best cosine so far", title=f"{LABELS[name]}: {len(best)} trials")
    upper.legend(loc="lower right")
    ends = np.sort(evaluations[trials["is_success"]])
    share = 100.0 * np.arange(1, len(ends) + 1) / len(best)
    lower.step([0, *ends, images[-1]], [0, *share, share[-1] if len(share) else 0], where="post", color=COLORS[name])
    if (of_thesis := thesis_range(name, "success_rate")) is not None:
        lower.axhline(100 * of_thesis[0], color=THESIS_COLOR, linestyle="--", linewidth=1.2)
    lower.set(xlabel="images taken", ylabel="found (%)", ylim=(0, 105), xlim=(0, images[-1]))
    return figure


@styled
def draw_policy_episodes(trials: Trials) -> Figure:
    """Draws the evaluation of the policies: number of steps beside its lower bound, and the errors of the final poses.

    Args:
      trials: measures of `sac` from `evaluate`, arrays of [policy seeds, episodes].
    """
    steps, bound = trials["evaluations"].ravel(), trials["steps_lower_bound"].ravel()
    figure = Figure(figsize=(10, 4.0))
    counts, rotation, translation = figure.subplots(1, 3, width_ratios=(1.6, 1, 1))
    numbers = np.arange(1, max(steps.max(), bound.max()) + 1)
    share = [100.0 * np.bincount(x, minlength=numbers[-1] + 1)[1:] / x.size for x in (steps, bound)]
    counts.bar(numbers - 0.2, share[0], 0.4, color=COLORS["sac"], label=f"ours, mean {steps.mean():.2f}")
    counts.bar(numbers + 0.2, share[1], 0.4, color="#b9d8cd", label=f"lower bound (estimate), mean {bound.mean():.2f}")
    thesis_mean = _thesis_mean("evaluations_mean")
    counts.axvline(thesis_mean, color=THESIS_COLOR, linestyle="--", label=f"thesis, mean {thesis_mean:g}")
    figure.suptitle(f"{steps.size:,} episodes", x=0.01, ha="left")
    counts.set(xlabel="steps of an episode", ylabel="episodes (%)")
    counts.xaxis.get_major_locator().set_params(integer=True)
    _legend_above(counts)
    degrees, centimetres = np.rad2deg(trials["rotation_error"]).ravel(), 100 * trials["translation_error"].ravel()
    _plot_errors(rotation, degrees, "rotational error (°)", "°", _thesis_mean("rotation_error_deg_mean"))
    thesis_mean = _thesis_mean("translation_error_cm_mean")
    _plot_errors(translation, centimetres, "translational error (cm)", " cm", thesis_mean)
    return figure


def _thesis_mean(key: str) -> float:
    """Returns the thesis's mean of a measure of its policy."""
    value = thesis_range("sac", key)
    assert value is not None  # the thesis gives all measures that are drawn
    return value[0]


def _plot_errors(axes: Axes, errors: np.ndarray, label: str, unit: str, thesis_mean: float) -> None:
    """Plots a histogram of errors, their median and the thesis's mean. The last bar also holds the largest errors."""
    limit = np.percentile(errors, 99)
    shown = np.clip(errors, 0, limit)
    axes.hist(shown, 30, color=COLORS["sac"], weights=np.full(errors.size, 100.0 / errors.size))
    median = np.median(errors)
    axes.axvline(float(median), color=INK, linewidth=1.2, label=f"median {median:.2f}{unit}")
    axes.axvline(thesis_mean, color=THESIS_COLOR, linestyle="--", label=f"thesis, mean {thesis_mean:g}{unit}")
    last_bar = f"last bar: also those\nabove {limit:.3g}, up to {errors.max():.3g}"
    axes.set(xlabel=f"{label}\n{last_bar}", ylabel="episodes (%)")
    _legend_above(axes)


def _legend_above(axes: Axes) -> None:
    """Puts the legend above the plot, where it hides no bar."""
    axes.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), borderaxespad=0.2)


@styled
def draw_comparison(results: Results) -> Figure:
    """Draws success rate, number of images and pose errors of every searcher, ours beside the thesis's.

    Args:
      results: content of `results.json`.
    """
    panels = {
        "pose_success_rate": ("pose success (%)", 100.0),
        "success_rate": ("success by cosine (%)", 100.0),
        "evaluations_mean": ("images or steps, mean", 1.0),
        "rotation_error_deg_mean": ("rotational error, mean (°)", 1.0),
        "translation_error_cm_mean": ("translational error, mean (cm)", 1.0),
    }
    figure = Figure(figsize=(14, 3.8))
    for axes, (key, (label, scale)) in zip(figure.subplots(1, len(panels)), panels.items(), strict=True):
        for position, name in enumerate(LABELS):
            ours, interval = scale * results[name][key], results[name][f"{key}_ci95"]
            axes.bar(position - 0.2, ours, 0.38, color=COLORS[name])
            if interval is not None:
                _plot_interval(axes, position - 0.2, scale * np.array(interval))
            of_thesis = thesis_range(name, key)
            if of_thesis is None:
                continue
            low, high = (scale * value for value in of_thesis)
            # A range is a bar from its lowest to its highest value: the thesis gives no value between them.
            bottom = low if low < high else 0.0
            axes.bar(
                position + 0.2, high - bottom, 0.38, bottom, color=THESIS_COLOR, alpha=0.5, hatch="///", edgecolor="w"
            )
        axes.set_xticks(range(len(LABELS)), LABELS.values(), rotation=40, ha="right")
        axes.set_title(label, fontsize=10)
        axes.grid(axis="x", visible=False)
    figure.supxlabel(
        "coloured: ours with 95 % intervals; hatched: thesis; a range is a bar that does not start at 0", fontsize=9
    )
    return figure


def _plot_interval(axes: Axes, position: float, ends: np.ndarray) -> None:
    axes.plot([position, position], ends, color=INK, linewidth=1.2)


@styled
def draw_search_strip(images: np.ndarray, cosines: Sequence[float], target: np.ndarray) -> Figure:
    """Draws the images that one search took, with the cosine below each, and the target image at the end.

    Args:
      images: f32[N, H, W, 3] in [0, 1], the N images of H x W pixels, the initial view first. A row holds eight.
      cosines: similarity of each image to the target, N cosines.
      target: target image, f32[H, W, 3] in [0, 1].
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
