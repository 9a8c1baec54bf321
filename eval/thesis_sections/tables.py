"""Tables of the thesis and their Markdown page: ours beside the thesis's, with counts and intervals."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from thesis_sections.published import TABLE_5_1, TABLE_5_2
from vsearch_jax.report.statistics import mean_interval, rate_interval
from vsearch_jax.report.summary import summarize_trials
from vsearch_jax.report.thesis import THESIS
from vsearch_jax.search import LABELS

Arrays = Mapping[str, np.ndarray]
Row = dict[str, Any]  # plain values of JSON; the keys hold the units
"""One row of a table."""

_FIGURES = {
    "3.1": "Views that the arm can reach",
    "5.1": "Random search: final cosine for four k",
    "5.2": "Random search: rotational error for four k",
    "5.3": "Random search: translational error for four k",
    "5.4": "Random search: final cosine",
    "5.5": "Random search: rotational error",
    "5.6": "Random search: translational error",
    "5.7": "CMA-ES: final cosine",
    "5.8": "CMA-ES: rotational error",
    "5.9": "CMA-ES: translational error",
    "5.10": "Comparison: means and standard deviations of the trials that met the threshold",
    "5.11": "CMA-ES: unreachable samples by generation, with the penalty and with bounds",
    "5.12": "Soft actor-critic: reward and losses over the training",
    "5.13": "Soft actor-critic: evaluation",
}


def table_5_1(outcomes: Mapping[str, Arrays]) -> list[Row]:
    """Returns table 5.1: random search for four k.

    Args:
      outcomes: {"k 0.5": measures, ...}, arrays of [initial views, runs].
    """
    rows = []
    for name, arrays in outcomes.items():
        k = float(name.split()[1])
        ours = summarize_trials(arrays)
        keys = ("final_cosine_mean", "rotation_error_deg_mean", "translation_error_cm_mean")
        row: Row = {"k": k, "trials": ours["episodes"]}
        for key, published in zip(keys, TABLE_5_1[k], strict=True):
            row |= {key: ours[key], f"{key}_ci95": ours[f"{key}_ci95"], f"{key}_thesis": published}
        rows.append(row | {key: ours[key] for key in ("success_rate", "success_rate_ci95", "pose_success_rate")})
    return rows


def searcher_rows(outcomes: Mapping[str, Arrays]) -> list[Row]:
    """Returns sections 5.1 to 5.3: success and costs of the searchers, beside the thesis's.

    Args:
      outcomes: {key of `LABELS`: measures}, arrays of [initial views, runs] or [policies, episodes].
    """
    rows = []
    for name, arrays in outcomes.items():
        ours, published = summarize_trials(arrays), THESIS.get(name, {})
        row: Row = {"searcher": LABELS[name], "trials": ours["episodes"]}
        for key in ("success_rate", "evaluations_mean", "rotation_error_deg_mean", "translation_error_cm_mean"):
            row |= {key: ours[key], f"{key}_ci95": ours[f"{key}_ci95"], f"{key}_thesis": published.get(key)}
        failed = ~arrays["is_success"]
        if failed.any():
            row["failed_cosine_range"] = _range(arrays["final_cosine"][failed])
            row["failed_rotation_error_deg_range"] = _range(np.rad2deg(arrays["rotation_error"][failed]))
        rows.append(row | {key: ours[key] for key in ("pose_success_rate", "pose_success_rate_ci95")})
    return rows


def wide_sweep(outcomes: Mapping[str, Arrays]) -> list[Row]:
    """Returns random search for several shares of wide samples, which the thesis does not have.

    Args:
      outcomes: {"wide 0": measures, ...}, arrays of [initial views, runs].
    """
    rows = []
    for name, arrays in outcomes.items():
        ours = summarize_trials(arrays)
        keys = ("pose_success_rate", "evaluations_mean", "rotation_error_deg_mean")
        row = {"num_wide": int(name.split()[1]), "trials": ours["episodes"]}
        rows.append(row | {f"{key}{end}": ours[f"{key}{end}"] for key in keys for end in ("", "_ci95")})
    return rows


def table_5_2(outcomes: Mapping[str, Arrays]) -> list[Row]:
    """Returns table 5.2: CMA-ES with the penalty, and with bounds, from the thesis's three initial errors.

    Args:
      outcomes: {"penalty": measures, "bounds": ..., "bounds_restarts": ...}, arrays of [initial views, runs].
    """
    rows = []
    for trial, published in enumerate(TABLE_5_2):
        first = {key: float(values[trial, 0]) for key, values in outcomes["penalty"].items() if values.ndim == 2}
        row: Row = {
            "trial": trial + 1,
            "initial_cosine": first["initial_cosine"],
            "initial_rotation_error_deg": float(np.rad2deg(first["initial_rotation_error"])),
            "initial_translation_error_cm": 100.0 * first["initial_translation_error"],
            "thesis": dict(
                zip(("initial_cosine", "initial_deg", "initial_cm", "final_cosine"), published, strict=True)
            ),
        }
        for name, arrays in outcomes.items():
            is_success = arrays["is_success"][trial][None]
            row[name] = {
                "final_cosine_first_run": float(arrays["final_cosine"][trial, 0]),
                "final_cosine_mean": float(arrays["final_cosine"][trial].mean()),
                "final_cosine_mean_ci95": mean_interval(arrays["final_cosine"][trial][None]),
                "success_rate": float(is_success.mean()),
                "success_rate_ci95": rate_interval(is_success),
                "runs": int(is_success.size),
                "images_mean": float(arrays["evaluations"][trial].mean()),
                "unreachable_first_generation_mean": float(arrays["unreachable_by_generation"][trial, :, 0].mean()),
            }
        rows.append(row)
    return rows


def _range(values: np.ndarray) -> list[float]:
    return [float(values.min()), float(values.max())]


def to_markdown(content: Mapping[str, Any]) -> str:
    """Returns the page of all tables and figures.

    Args:
      content: what `thesis.json` holds.
    """
    lines = ["# The thesis's tables and figures, ours beside the thesis's", ""]
    lines += [f"Written by `{content['command']}`. Encoder: {content['encoder']}. Intervals are 95 %, of clusters.", ""]
    lines += ["## Table 5.1: random search for four k", ""]
    lines += _table(
        ["k", "trials", "final cosine", "rotational error (°)", "translational error (cm)", "success by cosine (%)"],
        [
            [
                f"{row['k']:g}",
                str(row["trials"]),
                _cell(row, "final_cosine_mean", 3),
                _cell(row, "rotation_error_deg_mean", 1),
                _cell(row, "translation_error_cm_mean", 1),
                _percent(row, "success_rate"),
            ]
            for row in content["table_5_1"]
        ],
    )
    lines += ["", "## Sections 5.1 to 5.5: all searchers", "", *_searchers(content["searchers"])]
    title = "## Random search: samples in ten that are uniform over the band (ours; 0 is the thesis's)"
    lines += ["", title, "", *_wide_samples(content["wide_sweep"])]
    lines += ["", "## Table 5.2: CMA-ES with the penalty, and solved with bounds", ""]
    header = ["trial", "initial cosine", "initial °", "initial cm", "penalty: final cosine of the first run"]
    header += ["penalty: success (%)", "bounds: success (%), images", "bounds and restarts: success (%), images"]
    lines += _table(header, [_penalty_cells(row) for row in content["table_5_2"]])
    for number, title in _FIGURES.items():
        lines += ["", f"## Figure {number}: {title}", "", f"![{title}](figures/{figure_name(number)})"]
    return "\n".join(lines) + "\n"


def _searchers(rows: Sequence[Row]) -> list[str]:
    return _table(
        [
            "",
            "trials",
            "success by cosine (%)",
            "pose success (%)",
            "images or steps",
            "rotational error (°)",
            "translational error (cm)",
            "failures: cosine, °",
        ],
        [
            [
                row["searcher"],
                str(row["trials"]),
                _percent(row, "success_rate"),
                _percent(row, "pose_success_rate"),
                _cell(row, "evaluations_mean", 1),
                _cell(row, "rotation_error_deg_mean", 1),
                _cell(row, "translation_error_cm_mean", 1),
                _failures(row),
            ]
            for row in rows
        ],
    )


def _wide_samples(rows: Sequence[Row]) -> list[str]:
    return _table(
        ["wide samples", "trials", "pose success (%)", "images", "rotational error (°)"],
        [
            [
                str(row["num_wide"]),
                str(row["trials"]),
                _percent(row, "pose_success_rate"),
                _cell(row, "evaluations_mean", 1),
                _cell(row, "rotation_error_deg_mean", 1),
            ]
            for row in rows
        ],
    )


def figure_name(number: str) -> str:
    """Returns the file name of a figure of the thesis, for example "figure_5_1.png" of "5.1"."""
    return f"figure_{number.replace('.', '_')}.png"


def _penalty_cells(row: Row) -> list[str]:
    published = row["thesis"]
    solved = [
        f"{_percent(row[name], 'success_rate')}, {row[name]['images_mean']:.0f}"
        for name in ("bounds", "bounds_restarts")
    ]
    return [
        str(row["trial"]),
        f"{row['initial_cosine']:.2f} / {published['initial_cosine']:g}",
        f"{row['initial_rotation_error_deg']:.0f} / {published['initial_deg']:g}",
        f"{row['initial_translation_error_cm']:.0f} / {published['initial_cm']:g}",
        f"{row['penalty']['final_cosine_first_run']:.2f} / {published['final_cosine']:g}",
        _percent(row["penalty"], "success_rate"),
        *solved,
    ]


def _cell(row: Row, key: str, digits: int) -> str:
    """Returns our value with its interval, and after a slash the thesis's."""
    text = f"{row[key]:.{digits}f}"
    if row.get(f"{key}_ci95"):
        low, high = row[f"{key}_ci95"]
        text += f" ({low:.{digits}f}–{high:.{digits}f})"
    published = row.get(f"{key}_thesis")
    if published is None:
        return text
    ends = published if isinstance(published, list) else [published]
    return f"{text} / {'–'.join(f'{end:g}' for end in ends)}"


def _percent(row: Row, key: str) -> str:
    scaled = {key: 100.0 * row[key], f"{key}_ci95": [100.0 * end for end in row[f"{key}_ci95"]]}
    published = row.get(f"{key}_thesis")
    return _cell(scaled | {f"{key}_thesis": None if published is None else 100.0 * published}, key, 1)


def _failures(row: Row) -> str:
    if "failed_cosine_range" not in row:
        return "none"
    cosine, degrees = row["failed_cosine_range"], row["failed_rotation_error_deg_range"]
    return f"{cosine[0]:.2f}–{cosine[1]:.2f}, {degrees[0]:.0f}–{degrees[1]:.0f}"


def _table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    return [f"| {' | '.join(cells)} |" for cells in (header, ["---"] * len(header), *rows)]
