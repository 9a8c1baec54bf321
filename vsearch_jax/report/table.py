"""The table of results: ours beside the thesis's, for the terminal and for the page."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

from rich.console import Console
from rich.table import Table

from vsearch_jax.report.summary import SEARCHERS

FOOTNOTE = (
    "Ours: all trials, 95 % intervals (Wilson for rates, bootstrap for means). "
    "Thesis: means of random search and CMA-ES are over the trials that met the threshold; SAC for one target. "
    "Our CMA-ES restarts where it stalls and ties its step size to the cosine."
)


class Measure(NamedTuple):
    """A row of the table.

    Attributes:
      key: name in `results.json`.
      label: what the row is called, with its unit.
      scale: factor from the file's unit to the label's.
      digits: decimals shown.
    """

    key: str
    label: str
    scale: float = 1.0
    digits: int = 1


MEASURES = (
    Measure("success_rate", "success (%)", 100.0, 2),
    Measure("episodes", "trials", digits=0),
    Measure("evaluations_mean", "images or steps, mean", digits=2),
    Measure("evaluations_p99", "images or steps, 99th percentile", digits=0),
    Measure("steps_lower_bound_mean", "fewest steps possible, mean", digits=2),
    Measure("final_cosine_mean", "final cosine, mean", digits=4),
    Measure("rotation_error_deg_mean", "rotational error, mean (°)", digits=2),
    Measure("rotation_error_deg_median", "rotational error, median (°)", digits=2),
    Measure("frobenius_angle_deg_mean", "formula 3.2, mean (°)", digits=2),
    Measure("translation_error_cm_mean", "translational error, mean (cm)", digits=2),
    Measure("false_positive_rate", "false positives (%)", 100.0, 2),
    Measure("unreachable_rate", "unreachable (%)", 100.0, 2),
    Measure("joint_travel_rad_mean", "joint travel, mean (rad)", digits=1),
    Measure("motion_time_s_mean", "time of the motions, mean (s)", digits=1),
    Measure("plans_mean", "motions planned, mean", digits=2),
    Measure("helped_rate", "episodes with steps of help (%)", 100.0, 2),
    Measure("unaided_success_rate", "success without any help (%)", 100.0, 2),
    Measure("environment_steps", "environment steps of training", digits=0),
)


class Cell(NamedTuple):
    """What the table shows of a measure for a searcher, as text; empty where there is nothing."""

    ours: str
    interval: str
    thesis: str


def rows(results: Mapping[str, Any]) -> list[tuple[str, list[Cell]]]:
    """Returns label and cells of each measure, the cells in the order of `SEARCHERS`.

    Args:
      results: what `results.json` holds.
    """
    return [
        (measure.label, [_cell(measure, results[name], results["thesis"][name]) for name in SEARCHERS])
        for measure in MEASURES
    ]


def regime(results: Mapping[str, Any]) -> str:
    """Returns how the arm moved, in words."""
    needed = "joints are" if results["reachable"] == "ik" else "a path is"
    return f"{results['motion']} motion; a view is reachable where {needed} found"


def print_table(results: Mapping[str, Any], console: Console) -> None:
    """Prints the table of results, searcher after searcher, and a line for each policy seed."""
    table = Table(
        title=f"View search: ours beside the thesis ({regime(results)})", caption=FOOTNOTE, caption_justify="left"
    )
    table.add_column("")
    for heading in ("ours", "95 % interval", "thesis"):
        table.add_column(heading, justify="right")
    for place, name in enumerate(SEARCHERS.values()):
        table.add_section()
        table.add_row(name, style="bold")
        for label, cells in rows(results):
            if cells[place].ours:
                table.add_row(f"  {label}", *cells[place])
    console.print(table)
    for seed in results["sac"]["seeds"]:
        console.print(
            f"SAC seed {seed['seed']}: success {100 * seed['success_rate']:.2f} %, "
            f"{seed['evaluations_mean']:.2f} steps (at least {seed['steps_lower_bound_mean']:.2f}), "
            f"rotational error {seed['rotation_error_deg_median']:.2f}° (median), "
            f"false positives {100 * seed['false_positive_rate']:.2f} %, "
            f"unreachable {100 * seed['unreachable_rate']:.2f} %",
            highlight=False,
        )


def _cell(measure: Measure, ours: Mapping[str, Any], thesis: Mapping[str, Any]) -> Cell:
    interval = ours.get(f"{measure.key}_ci95")
    return Cell(
        _text(measure, ours.get(measure.key)), _text(measure, interval), _text(measure, thesis.get(measure.key))
    )


def _text(measure: Measure, value: float | list[float] | None) -> str:
    if value is None:
        return ""
    ends = value if isinstance(value, list) else [value]
    return "–".join(f"{measure.scale * end:,.{measure.digits}f}" for end in ends)
