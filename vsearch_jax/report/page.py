"""Writes results.json, the figures and a self-contained HTML page of a run."""

from __future__ import annotations

import base64
import io
import json
from collections.abc import Mapping
from pathlib import Path

import jinja2
from matplotlib.figure import Figure

from vsearch_jax.config import Config
from vsearch_jax.report import figures
from vsearch_jax.report.style import styled
from vsearch_jax.report.summary import Results, false_positive_warning, summarize_results, to_trials
from vsearch_jax.report.table import FOOTNOTE, describe_motion, table_rows
from vsearch_jax.runs.atomic import write_atomically
from vsearch_jax.runs.loop import Evaluated
from vsearch_jax.scene import describe_symmetry, object_symmetry
from vsearch_jax.search import BLACK_BOX, LABELS

CAPTIONS = {
    "search": "One search by the policy; it starts behind the object",
    "comparison": "Comparison of the searchers",
    **{name: LABELS[name] for name in BLACK_BOX},
    "sac_evaluation": "SAC policy alone, evaluation",
    "training": "Training",
    "reachability": "Reachable views",
}
"""Caption of each figure by file name, in the order of the page."""


def write_report(folder: Path, evaluated: Evaluated, config: Config) -> Results:
    """Makes the report of a run: computes the results, draws the figures, and writes all files into `folder`.

    The files are results.json, figures/*.png and report.html. Existing files of these names are replaced.

    Args:
      folder: an existing folder: the run's, or another one.
      evaluated: measures of all searchers and of the training, from `runs.loop.evaluate_run`.
      config: the run's config.

    Returns:
      Content of `results.json`.

    Raises:
      OSError: the disk is full or not writable.
    """
    results = summarize_results(evaluated.arrays, config, evaluated.wall_seconds)
    results |= {"seed": evaluated.seed, "symmetry": object_symmetry(config.scene)}
    write_files(folder, results, draw_figures(results, evaluated, config), config)
    return results


def draw_figures(results: Results, evaluated: Evaluated, config: Config) -> dict[str, Figure]:
    """Draws all figures of a run's report.

    Args:
      results: content of `results.json`.
      evaluated: measures of all searchers and of the training, from `runs.loop.evaluate_run`.
      config: the run's config.

    Returns:
      {file name: figure}; `CAPTIONS` has the same keys.
    """
    trials = {name: to_trials(outcome) for name, outcome in evaluated.arrays.items()}
    search, threshold = evaluated.search, config.env.threshold
    progress = {
        name: figures.draw_search_progress(name, trials[name], build(config).num_views, threshold)
        for name, build in BLACK_BOX.items()
    }
    shown = slice(0, int(search["num_steps"]) + 1)
    cosines = search["similarity"][shown].tolist()
    return {
        "search": figures.draw_search_strip(search["images"][shown], cosines, search["target"]),
        "comparison": figures.draw_comparison(results),
        **progress,
        "sac_evaluation": figures.draw_policy_episodes(trials["sac"]),
        "training": figures.draw_training(evaluated.lines, config),
        "reachability": figures.draw_reachability(evaluated.reach),
    }


def write_files(folder: Path, results: Results, pictures: Mapping[str, Figure], config: Config) -> None:
    """Writes results and figures that are already computed as results.json, figures/*.png and report.html.

    Existing files of these names are replaced.

    Args:
      folder: an existing folder, for all files.
      results: content of `results.json`.
      pictures: figures by file name, from `draw_figures`.
      config: the run's config.

    Raises:
      OSError: the disk is full or not writable.
      ValueError: `results` holds NaN or infinity; nothing is written then.
    """
    text = json.dumps(results, indent=2, allow_nan=False) + "\n"  # first: it may raise
    (folder / "figures").mkdir(exist_ok=True)
    images = {name: to_png(picture) for name, picture in pictures.items()}
    for name, image in images.items():
        write_atomically(folder / "figures" / f"{name}.png", image)
    write_atomically(folder / "report.html", _render_page(folder.absolute().name, results, images, config))
    # Last: a report with results.json is complete.
    write_atomically(folder / "results.json", text)


@styled
def to_png(picture: Figure) -> bytes:
    """Converts a matplotlib figure to the bytes of a PNG file."""
    buffer = io.BytesIO()
    picture.savefig(buffer, format="png")
    return buffer.getvalue()


def _render_page(title: str, results: Results, images: Mapping[str, bytes], config: Config) -> str:
    loader = jinja2.PackageLoader("vsearch_jax.report", "")
    template = jinja2.Environment(loader=loader, autoescape=True, undefined=jinja2.StrictUndefined).get_template(
        "page.html"
    )
    pictures = [(CAPTIONS[name], base64.b64encode(image).decode()) for name, image in images.items()]
    return template.render(
        title=title,
        searchers=LABELS.values(),
        warning=false_positive_warning(results),
        rows=table_rows(results),
        footnote=FOOTNOTE,
        symmetry=describe_symmetry(results["symmetry"]),
        motion=describe_motion(results),
        seeds=results["sac"]["seeds"],
        pictures=pictures,
        results=results,
        config=json.dumps(config.to_dict(), indent=2),
    )
