"""The table of results, ours beside the thesis's, for the terminal and for the HTML page."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

from rich.console import Console
from rich.table import Table

from vsearch_jax.report.summary import Results
from vsearch_jax.search import LABELS

FOOTNOTE = (
    "Pose success: the cosine meets the threshold, and the rotation error is small. "
    "Ours: all trials, with 95 % intervals that count trials of one initial view or of one policy as related. "
    "Thesis: the means of random search and CMA-ES cover only the trials that met the threshold; SAC has one target. "
    "The row of wide samples says how often a uniform sample of random search helped (random_search.num_wide). "
    "Travel and time of motions ignore obstacles where a view counts as reachable by IK."
)


class Measure(NamedTuple):
    """A row of the table of results: which measure it shows, and how.

    Attributes:
      key: key in `results.json`.
      label: label of the row, with its unit.
      scale: factor from the unit of the file to the unit of the label.
      digits: decimals to show.
    """

    key: str
    label: str
    scale: float = 1.0
    digits: int = 1


MEASURES = (
    Measure("pose_success_rate", "pose success, error ≤ 10° (%)", 100.0, 2),
    Measure("pose_success_5deg_rate", "pose success, error ≤ 5° (%)", 100.0, 2),
    Measure("success_rate", "success by cosine (%)", 100.0, 2),
    Measure("episodes", "trials", digits=0),
    Measure("evaluations_mean", "images or steps, mean", digits=2),
    Measure("evaluations_p99", "images or steps, 99th percentile", digits=0),
    Measure("steps_lower_bound_mean", "lower bound on steps (estimate), mean", digits=2),
    Measure("below_bound_rate", "episodes below the estimate (%)", 100.0, 2),
    Measure("final_cosine_mean", "final cosine, mean", digits=4),
    Measure("rotation_error_deg_mean", "rotational error, mean (°)", digits=2),
    Measure("rotation_error_deg_median", "rotational error, median (°)", digits=2),
    Measure("frobenius_angle_deg_mean", "formula 3.2, mean (°)", digits=2),
    Measure("translation_error_cm_mean", "translational error, mean (cm)", digits=2),
    Measure("mssd_cm_mean", "largest error on the object (MSSD), mean (cm)", digits=2),
    Measure("false_positive_rate", "false positives (%)", 100.0, 2),
    Measure("unreachable_rate", "unreachable (%)", 100.0, 2),
    Measure("joint_travel_rad_mean", "joint travel, mean (rad)", digits=1),
    Measure("motion_time_s_mean", "motion time, mean (s)", digits=1),
    Measure("plans_mean", "planned motions, mean", digits=2),
    Measure("helped_rate", "episodes with help steps (%)", 100.0, 2),
    Measure("wide_rate", "trials that used a wide sample (%)", 100.0, 2),
    Measure("restarts_mean", "restarts, mean", digits=2),
    Measure("scan_images_mean", "images of uniform scans, mean", digits=2),
    Measure("environment_steps", "training environment steps", digits=0),
    Measure("images_rendered", "images rendered in training", digits=0),
)


class Cell(NamedTuple):
    """One measure of one searcher as text. An empty text means that there is no value.

    Attributes:
      ours: our value.
      interval: 95 % interval of our value.
      thesis: the thesis's value or range.
    """

    ours: str
    interval: str
    thesis: str


def table_rows(results: Results) -> list[tuple[str, list[Cell]]]:
    """Formats the rows of the results table, one for each metric.

    Args:
      results: what `results.json` holds.

    Returns:
      For each metric its label and its cells: one for each searcher, in the order of `search.LABELS`.
    """
    return [
        (measure.label, [_cell(measure, results[name], results["thesis"].get(name, {})) for name in LABELS])
        for measure in MEASURES
    ]


def describe_motion(results: Results) -> str:
    """Returns a phrase for the table's title: how the arm moved in the evaluation, and what counted as reachable."""
    condition = "IK finds joints" if results["reachable"] == "ik" else "a path is found"
    return f"{results['motion']} motion; a view is reachable if {condition}"


def print_table(results: Results, console: Console) -> None:
    """Prints the results of a run as a table, one searcher after another, and one line for each policy seed.

    Args:
      results: content of `results.json`.
      console: the rich console to print on.
    """
    table = Table(
        title=f"View search: ours beside the thesis ({describe_motion(results)})",
        caption=FOOTNOTE,
        caption_justify="left",
    )
    table.add_column("")
    for heading in ("ours", "95 % interval", "thesis"):
        table.add_column(heading, justify="right")
    rows = table_rows(results)
    for column, name in enumerate(LABELS.values()):
        table.add_section()
        table.add_row(name, style="bold")
        for label, cells in rows:
            if cells[column].ours:
                table.add_row(f"  {label}", *cells[column])
    console.print(table)
    for seed in results["sac"]["seeds"]:
        console.print(
            f"SAC alone, seed {seed['seed']}: pose success {100 * seed['pose_success_rate']:.2f} %, "
            f"{seed['evaluations_mean']:.2f} steps (estimate of the lower bound {seed['steps_lower_bound_mean']:.2f}), "
            f"rotational error {seed['rotation_error_deg_median']:.2f}° (median), "
            f"false positives {100 * seed['false_positive_rate']:.2f} %, "
            f"unreachable {100 * seed['unreachable_rate']:.2f} %",
            highlight=False,
        )


def _cell(measure: Measure, ours: Results, thesis: Mapping[str, float | list[float]]) -> Cell:
    interval = ours.get(f"{measure.key}_ci95")
    return Cell(
        _text(measure, ours.get(measure.key)), _text(measure, interval), _text(measure, thesis.get(measure.key))
    )


def _text(measure: Measure, value: float | list[float] | None) -> str:
    if value is None:
        return ""
    values = value if isinstance(value, list) else [value]
    return "–".join(f"{measure.scale * number:,.{measure.digits}f}" for number in values)
