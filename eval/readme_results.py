"""Writes the results section of README.md from a run's results.json: `python eval/readme_results.py [RUN]`.

With a run, its results.json is copied to docs/results/teapot.json first. Commit both files.
"""

from __future__ import annotations

import argparse
import json
import shutil
import sys
from pathlib import Path

from vsearch_jax.report.summary import Results, false_positive_warning
from vsearch_jax.report.table import table_rows
from vsearch_jax.search import LABELS

ROOT = Path(__file__).resolve().parents[1]
README, RESULTS = ROOT / "README.md", ROOT / "docs" / "results" / "teapot.json"
BEGIN, END = "<!-- results: written by eval/readme_results.py -->", "<!-- end of results -->"


def results_section(results: Results) -> str:
    """Returns the section as Markdown: a table of all measures of all searchers, and a line for each policy.

    Args:
      results: content of a run's results.json.
    """
    lines = [
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
            f"{seed['evaluations_mean']:.2f} steps, {seed['evaluations_over_lower_bound']:.3f} times the lower bound."
        )
    seconds = results["wall_seconds"]
    stages = ", ".join(f"{stage} {value:.0f} s" for stage, value in seconds.items())
    lines.append(f"- **Wall time**: {stages}, on {results['machine']['device']}, seed {results['seed']}.")
    warning = false_positive_warning(results)
    return "\n".join([*lines, *([f"- {warning}"] if warning else [])]) + "\n"


def with_section(readme: str, section: str) -> str:
    """Returns the text of README.md with the section between its two marks replaced.

    Args:
      readme: text of README.md.
      section: the new section.
    """
    before, rest = readme.split(BEGIN)
    return before + BEGIN + "\n\n" + section + "\n" + END + rest.split(END)[1]


def main(arguments: list[str]) -> None:
    """Writes README.md."""
    parser = argparse.ArgumentParser(description="Writes the results section of README.md.")
    parser.add_argument("run", type=Path, nargs="?", help="folder of a finished run of the preset `cpu`")
    options = parser.parse_args(arguments)
    if options.run:
        RESULTS.parent.mkdir(exist_ok=True)
        shutil.copyfile(options.run / "results.json", RESULTS)
    results = json.loads(RESULTS.read_text(encoding="utf-8"))
    README.write_text(with_section(README.read_text(encoding="utf-8"), results_section(results)), encoding="utf-8")


if __name__ == "__main__":
    main(sys.argv[1:])
