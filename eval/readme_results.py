"""Writes the results of README.md from the files in docs/results: `python eval/readme_results.py [NAME=FOLDER ...]`.

Each FOLDER is that of a run or of an evaluation. Its results.json is copied to docs/results/NAME.json first. Paths
in it are reduced to file names. `teapot` is the run of the large table, `teapot-dynamic` its evaluation with dynamics.
All other names are rows of the table of other runs, in the order of the names. `moves.json` is written by
eval/moves.py. Commit README.md and the files.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jinja2

import vsearch_jax as vs
from vsearch_jax.cli.errors import one_line_errors
from vsearch_jax.report.summary import Results, false_positive_warning
from vsearch_jax.report.table import table_rows
from vsearch_jax.runs import write_atomically
from vsearch_jax.search import LABELS

ROOT = Path(__file__).resolve().parents[1]
TEMPLATE = "readme_protocol.md.jinja"
README, FOLDER = ROOT / "README.md", ROOT / "docs" / "results"
MAIN, DYNAMIC, MOVES = "teapot", "teapot-dynamic", "moves"
"""Names of the files with a section of their own."""


def results_section(results: Results) -> str:
    """Returns the section as Markdown: a table of all measures of all searchers, and a line for each policy.

    Args:
      results: content of a run's results.json.
    """
    lines = [
        f"One run of `vsearch train {_options(results)}`.",
        "Brackets are 95 % intervals. They count trials that start at one initial view, and episodes of one policy, as",
        "related. With one policy its interval is that of its episodes, and says nothing about another training.",
        "",
        "| | " + " | ".join(LABELS.values()) + " | thesis: random / CMA-ES / SAC |",
        "|---" * (len(LABELS) + 2) + "|",
    ]
    for label, cells in table_rows(results):
        ours = [f"{cell.ours} ({cell.interval})" if cell.interval else cell.ours for cell in cells]
        thesis = [cells[list(LABELS).index(name)].thesis for name in ("random_search", "cma_es", "sac")]
        of_thesis = " / ".join(value or "–" for value in thesis) if any(thesis) else ""
        lines.append(f"| {label} | " + " | ".join(ours) + f" | {of_thesis} |")
    lines.append("")
    for seed in results["sac"]["seeds"]:
        lines.append(
            f"- **Policy {seed['seed']} alone**: pose success {100 * seed['pose_success_rate']:.2f} %, "
            f"{seed['evaluations_mean']:.2f} steps, {seed['evaluations_over_lower_bound']:.3f} times the estimate of "
            "the lower bound."
        )
    seconds = results["wall_seconds"]
    stages = ", ".join(f"{stage} {value:.0f} s" for stage, value in seconds.items())
    lines.append(f"- **Wall time**: {stages}, on {results['machine']['device']}, seed {results['seed']}.")
    warning = false_positive_warning(results)
    return "\n".join([*lines, *([f"- {warning}"] if warning else []), _protocol(results)]) + "\n"


def _options(results: Results) -> str:
    """Returns the options of `vsearch train` that differ from the preset `cpu`, and the seed."""
    config, usual = results["config"], json.loads(json.dumps(vs.Config.preset("cpu").to_dict()))
    options = [f"--object {config['scene']['object']}"]
    for section, values in config.items():
        for field, value in values.items() if isinstance(values, dict) else ():
            if value != usual[section][field] and field != "object":
                options.append(f"--{section}.{field}".replace("_", "-") + f" {value}")
    return " ".join([*options, f"--seed {results['seed']}"])


def _protocol(results: Results) -> str:
    """Returns sentences on how the numbers came about, with the run's own settings."""
    loader = jinja2.FileSystemLoader(Path(__file__).parent)
    template = jinja2.Environment(loader=loader, undefined=jinja2.StrictUndefined).get_template(TEMPLATE)
    config = results["config"]
    return template.render(results=results, config=config, evaluation=config["evaluation"])


def other_runs_section(runs: dict[str, Results]) -> str:
    """Returns a table as Markdown: one row for each run, and in each cell one number for each searcher.

    Args:
      runs: {name: content of results.json}.
    """
    columns: dict[str, Callable[[Results], str]] = {
        "pose success, error ≤ 10° (%)": lambda row: f"{100 * row['pose_success_rate']:.1f}",
        "images or steps, mean": lambda row: f"{row['evaluations_mean']:.1f}",
        "rotational error, mean (°)": lambda row: f"{row['rotation_error_deg_mean']:.1f}",
        "median (°)": lambda row: f"{row['rotation_error_deg_median']:.1f}",
        "translational error, mean (cm)": lambda row: f"{row['translation_error_cm_mean']:.1f}",
        "false positives (%)": lambda row: f"{100 * row['false_positive_rate']:.1f}",
    }
    header = ["run", "options", *columns, "policy alone: episodes", "steps / lower bound (estimate)"]
    lines = [f"| {' | '.join(header)} |", "|---" * len(header) + "|"]
    for name, results in runs.items():
        cells = [" / ".join(number(results[searcher]) for searcher in LABELS) for number in columns.values()]
        policy = results["sac"]
        cells += [f"{policy['episodes']:,}", f"{policy['evaluations_over_lower_bound']:.3f}"]
        lines.append(f"| {name} | `{_options(results)}` | {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def dynamics_section(kinematic: Results, dynamic: Results, moves: dict[str, Any] | None) -> str:
    """Returns a table as Markdown that compares two evaluations of one run, and a sentence on the arm's accuracy.

    Args:
      kinematic: content of results.json with joints set.
      dynamic: the same with the arm's dynamics.
      moves: content of the file that eval/moves.py writes, if there is one.
    """
    rows: dict[str, Callable[[Results], str]] = {
        "pose success, error ≤ 10° (%)": lambda row: f"{100 * row['pose_success_rate']:.2f}",
        "images or steps, mean": lambda row: f"{row['evaluations_mean']:.2f}",
        "rotational error, mean (°)": lambda row: f"{row['rotation_error_deg_mean']:.2f}",
        "joint travel, mean (rad)": lambda row: f"{row['joint_travel_rad_mean']:.1f}",
        "motion time, mean (s)": lambda row: f"{row['motion_time_s_mean']:.1f}",
    }
    lines = ["| joints set / dynamics | " + " | ".join(LABELS.values()) + " |", "|---" * (len(LABELS) + 1) + "|"]
    for label, number in rows.items():
        cells = [f"{number(kinematic[name])} / {number(dynamic[name])}" for name in LABELS]
        lines.append(f"| {label} | " + " | ".join(cells) + " |")
    seconds = [results["wall_seconds"]["evaluation"] for results in (kinematic, dynamic)]
    lines += ["", f"The evaluation took {seconds[0]:.0f} s with joints set, {seconds[1]:.0f} s with dynamics."]
    if moves is not None:
        lines[-1] += (
            f" In {moves['planned']} random moves the camera came to rest "
            f"{moves['rest_error_micrometre_median']:.1f} µm from the plan (median; at most "
            f"{moves['rest_error_micrometre_max']:.1f} µm)."
        )
    return "\n".join(lines) + "\n"


def sections() -> dict[str, str]:
    """Returns the generated sections of README.md by name. A section without files is empty."""
    paths = sorted(FOLDER.glob("*.json"), key=lambda path: path.stem)
    files = {path.stem: json.loads(path.read_text(encoding="utf-8")) for path in paths}
    others = {name: results for name, results in files.items() if name not in (MAIN, DYNAMIC, MOVES)}
    has_dynamic = DYNAMIC in files
    return {
        "results": results_section(files[MAIN]),
        "other runs": other_runs_section(others) if others else "",
        "dynamics": dynamics_section(files[MAIN], files[DYNAMIC], files.get(MOVES)) if has_dynamic else "",
    }


def with_sections(readme: str, texts: dict[str, str]) -> str:
    """Returns the text of README.md with the text between the two marks of each section replaced.

    Args:
      readme: text of README.md.
      texts: new text of each section, by name.
    """
    for name, text in texts.items():
        begin, end = f"<!-- {name}: written by eval/readme_results.py -->", f"<!-- end of {name} -->"
        before, rest = readme.split(begin)
        readme = before + begin + "\n\n" + text + "\n" + end + rest.split(end)[1]
    return readme


def main(arguments: list[str]) -> None:
    """Writes README.md."""
    parser = argparse.ArgumentParser(description="Writes the results of README.md.")
    parser.add_argument("runs", nargs="*", metavar="NAME=FOLDER", help="a folder with a results.json to copy first")
    for item in parser.parse_args(arguments).runs:
        name, _, folder = item.partition("=")
        if not name or not folder:
            parser.error(f"{item!r} is not of the form NAME=FOLDER")
        FOLDER.mkdir(exist_ok=True)
        results = json.loads((Path(folder) / "results.json").read_text(encoding="utf-8"))
        scene = results["config"]["scene"]
        scene |= {part: Path(scene[part]).name for part in ("arm", "object", "obstacles") if scene[part]}
        write_atomically(FOLDER / f"{name}.json", json.dumps(results, indent=2) + "\n")
    README.write_text(with_sections(README.read_text(encoding="utf-8"), sections()), encoding="utf-8")


if __name__ == "__main__":
    with one_line_errors():
        main(sys.argv[1:])
