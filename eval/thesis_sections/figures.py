"""Figures 5.1 to 5.13 of the thesis, with its values beside ours."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from thesis_sections.published import FAILED_RUNS, TABLE_5_1, TABLE_5_2
from vsearch_jax.report.style import COLORS, INK, THESIS_COLOR, styled
from vsearch_jax.report.thesis import thesis_range
from vsearch_jax.search import LABELS

Arrays = Mapping[str, np.ndarray]
"""Measures of a searcher by name, arrays of [initial views, runs]."""

_MEASURES = (
    ("final_cosine", "final cosine", 1.0, "final_cosine_mean"),
    ("rotation_error", "rotational error (°)", 180.0 / np.pi, "rotation_error_deg_mean"),
    ("translation_error", "translational error (cm)", 100.0, "translation_error_cm_mean"),
)
"""Measure, label, factor to the label's unit, and key in `results.json`."""
_K_COLORS = ("#a6c4e5", "#3b6fb6", "#d1812c", "#8c3f1f")
_POLICY_PANELS = {
    "reward": "reward of a step",
    "critic_loss": "loss of the Q networks",
    "value_loss": "loss of the value network",
    "actor_loss": "loss of the policy",
}


@styled
def draw_k_sweep(outcomes: Mapping[str, Arrays], measure: int) -> Figure:
    """Draws figure 5.1, 5.2 or 5.3: a measure of random search by initial view, for each k.

    Args:
      outcomes: {"k 0.5": measures, ...}.
      measure: 0 cosine, 1 rotation, 2 translation.
    """
    key, label, scale, _ = _MEASURES[measure]
    figure = Figure(figsize=(8, 3.6))
    views, means = figure.subplots(1, 2, width_ratios=(3, 1.4))
    for i, (name, arrays) in enumerate(outcomes.items()):
        values = scale * arrays[key]
        x = np.arange(1, len(values) + 1) + 0.16 * (i - 1.5)
        views.scatter(np.repeat(x, values.shape[1]), values.ravel(), s=8, color=_K_COLORS[i], alpha=0.35, linewidth=0)
        views.scatter(x, values.mean(axis=1), s=42, marker="_", color=_K_COLORS[i], linewidth=2.4, label=name)
        means.bar(i - 0.2, values.mean(), 0.38, color=_K_COLORS[i])
        published = TABLE_5_1[float(name.split()[1])][measure]
        means.bar(i + 0.2, published, 0.38, color=THESIS_COLOR, alpha=0.5, hatch="///", edgecolor="white")
    views.set(xlabel="initial view", ylabel=label, xticks=range(1, 7))
    views.legend(ncols=4, loc="lower center", bbox_to_anchor=(0.5, 1.0))
    means.set(xticks=range(len(outcomes)), xticklabels=list(outcomes), title="mean (hatched: thesis)")
    means.grid(axis="x", visible=False)
    return figure


@styled
def draw_runs(name: str, arrays: Arrays, measure: int, threshold: float) -> Figure:
    """Draws one of figures 5.4 to 5.9: a measure of all trials by run, and the failed trials of each run.

    Args:
      name: "random_search" or "cma_es".
      arrays: measures of the searcher.
      measure: 0 cosine, 1 rotation, 2 translation.
      threshold: cosine at which a search ends.
    """
    key, label, scale, _ = _MEASURES[measure]
    values, failed = scale * arrays[key], ~arrays["is_success"]
    num_views, num_runs = values.shape
    figure = Figure(figsize=(8, 4.4))
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=(3, 1))
    offsets = np.linspace(-0.3, 0.3, num_views)[:, None]
    x = np.arange(1, num_runs + 1)[None] + offsets
    upper.scatter(x[~failed], values[~failed], s=14, color=COLORS[name], linewidth=0, label="threshold met")
    upper.scatter(x[failed], values[failed], s=26, marker="x", color=INK, linewidth=1.4, label="not met")
    if measure == 0:
        upper.axhline(threshold, color=INK, linestyle=":", linewidth=1.2, label=f"threshold {threshold:g}")
    upper.set(ylabel=label, title=f"{LABELS[name]}: {num_runs} runs of {num_views} trials")
    upper.legend(loc="lower center", bbox_to_anchor=(0.75, 1.0), ncols=3)
    thesis = [number in FAILED_RUNS[name] for number in range(1, num_runs + 1)]
    lower.bar(np.arange(1, num_runs + 1) - 0.2, failed.sum(axis=0), 0.38, color=COLORS[name], label="ours")
    bars = np.arange(1, num_runs + 1) + 0.2
    lower.bar(bars, thesis, 0.38, color=THESIS_COLOR, alpha=0.5, hatch="///", edgecolor="white", label="thesis")
    lower.set(
        xlabel="run", ylabel="failed", xticks=range(1, num_runs + 1), ylim=(0, max(2, failed.sum(axis=0).max()) + 0.5)
    )
    lower.legend(loc="upper right", ncols=2)
    return figure


@styled
def draw_comparison(outcomes: Mapping[str, Arrays]) -> Figure:
    """Draws figure 5.10: means and standard deviations of the searchers by initial view.

    Args:
      outcomes: {key of `LABELS`: measures}.
    """
    figure = Figure(figsize=(11, 3.6))
    for measure, axes in enumerate(figure.subplots(1, 3)):
        key, label, scale, summary_key = _MEASURES[measure]
        published = thesis_range("cma_es", summary_key)  # that of random search is equal
        assert published is not None
        axes.axhspan(*published, color=THESIS_COLOR, alpha=0.25, linewidth=0, label="thesis, threshold met")
        for i, (name, arrays) in enumerate(outcomes.items()):
            values = np.ma.masked_where(~arrays["is_success"], scale * arrays[key])
            x = np.arange(1, len(values) + 1) + 0.24 * (i - (len(outcomes) - 1) / 2)
            mean, std = (found.filled(np.nan) for found in (values.mean(axis=1), values.std(axis=1)))
            axes.errorbar(x, mean, std, fmt="o", markersize=4, color=COLORS[name], linewidth=1.2, label=LABELS[name])
        axes.set(xlabel="initial view", title=label, xticks=range(1, len(outcomes["random_search"][key]) + 1))
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=4)
    return figure


@styled
def draw_unreachable(outcomes: Mapping[str, Arrays], population: int) -> Figure:
    """Draws figure 5.11: the samples of each generation of CMA-ES that the arm cannot reach, and the best cosine.

    Args:
      outcomes: {"penalty": measures, "bounds": measures}.
      population: number of samples of a generation.
    """
    figure = Figure(figsize=(11, 5.2))
    panels = figure.subplots(2, len(TABLE_5_2), sharex=True)
    styles = {"penalty": (COLORS["cma_es_restarts"], "penalty"), "bounds": (COLORS["cma_es"], "bounds")}
    for trial, (upper, lower) in enumerate(panels.T):
        for name, (color, label) in styles.items():
            counts = outcomes[name]["unreachable_by_generation"][trial]
            best = outcomes[name]["best_scores"][trial]
            length = np.ceil((outcomes[name]["evaluations"][trial] - 1) / population).astype(int)
            generations = np.arange(1, counts.shape[-1] + 1)
            running = np.ma.masked_where(generations[None] > length[:, None], counts)
            upper.plot(generations, running[0], color=color, linewidth=1.0, alpha=0.5)
            upper.plot(generations, running.mean(axis=0), color=color, label=label)
            lower.plot(generations[: max(length[0], 1)], best[0, : max(length[0], 1)], color=color, label=label)
        lower.axhline(TABLE_5_2[trial][3], color=THESIS_COLOR, linestyle="--", linewidth=1.2, label="thesis, final")
        upper.set(title=f"trial {trial + 1}: {TABLE_5_2[trial][1]:g}° off", ylim=(-0.3, population + 0.3))
        lower.set(xlabel="generation", ylim=(-0.5, 1.05))
    panels[0, 0].set(ylabel="unreachable samples,\nmean of all runs (pale: first)")
    panels[1, 0].set(ylabel="best cosine, first run")
    handles, labels = panels[1, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3)
    return figure


@styled
def draw_policy_training(lines: Sequence[Mapping[str, float | str]], num_updates: int, num_envs: int) -> Figure:
    """Draws figure 5.12: reward and losses over the training of the thesis's policies.

    Args:
      lines: lines of metrics.jsonl.
      num_updates: number of encoder updates of the run, which come first.
      num_envs: number of environment steps of an iteration.
    """
    figure = Figure(figsize=(12, 3.2))
    for axes, (name, label) in zip(figure.subplots(1, 4), _POLICY_PANELS.items(), strict=True):
        points = [(line["iteration"], line[name]) for line in lines if name in line]
        axes.set(xlabel="environment steps", title=label)
        if not points:
            continue
        iterations, values = np.array(points).T
        width = max(1, len(values) // 40)
        steps = (iterations - num_updates + 1) * num_envs
        axes.plot(steps, values, color=COLORS["sac"], alpha=0.25, linewidth=0.8)
        axes.plot(steps[width - 1 :], np.convolve(values, np.ones(width) / width, mode="valid"), color=COLORS["sac"])
    return figure


@styled
def draw_policy_evaluation(arrays: Arrays) -> Figure:
    """Draws figure 5.13: number of steps, final cosine and errors of the evaluated episodes.

    Args:
      arrays: measures of the policies, arrays of [policy seeds, episodes].
    """
    figure = Figure(figsize=(12, 3.2))
    panels = figure.subplots(1, 4)
    shown = (("evaluations", "steps of an episode", 1.0, "evaluations_mean"), *_MEASURES)
    for axes, (key, label, scale, summary_key) in zip(panels, shown, strict=True):
        published = thesis_range("sac", summary_key)
        assert published is not None  # the thesis gives all measures that are drawn
        _plot_histogram(axes, scale * arrays[key].ravel(), published[0], label, is_count=key == "evaluations")
    panels[0].set(ylabel="episodes (%)")
    return figure


def _plot_histogram(axes: Axes, values: np.ndarray, published: float, label: str, is_count: bool) -> None:
    """Plots a histogram with our mean and the thesis's."""
    bins = np.arange(0.5, values.max() + 1.0).tolist() if is_count else 30
    axes.hist(values, bins, color=COLORS["sac"], weights=np.full(values.size, 100.0 / values.size))
    axes.axvline(values.mean(), color=INK, linewidth=1.2, label=f"mean {values.mean():.3g}")
    axes.axvline(published, color=THESIS_COLOR, linestyle="--", label=f"thesis {published:g}")
    axes.set(xlabel=label)
    axes.legend(loc="best")
