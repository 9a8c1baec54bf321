"""Writes a run's results.json, figures and a self-contained page that shows them."""

from __future__ import annotations

import base64
import io
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jinja2
from matplotlib.figure import Figure

from vsearch_jax.config import Config
from vsearch_jax.report import figures
from vsearch_jax.report.style import styled
from vsearch_jax.report.summary import SEARCHERS, results
from vsearch_jax.report.table import FOOTNOTE, regime, rows
from vsearch_jax.runs import atomic
from vsearch_jax.runs.loop import Evaluated

CAPTIONS = {
    "search": "A search by the policy, from the far side of the object",
    "comparison": "The searchers side by side",
    "random_search": "Random search",
    "cma_es": "CMA-ES",
    "sac_evaluation": "Soft actor-critic, evaluation",
    "training": "Training",
    "reachability": "Reachable views",
}
"""Figures of a run, by file name, in the order of the page."""


def write_report(folder: Path, evaluated: Evaluated, config: Config) -> dict[str, Any]:
    """Writes results.json, figures/*.png and report.html into `folder`, over those that are there.

    Args:
      folder: the run's folder, or another one.
      evaluated: what `runs.evaluate_run` returned.
      config: the run's config.

    Returns:
      What `results.json` holds.

    Raises:
      OSError: the disk is full or not writable.
    """
    summary = results(evaluated.arrays, config, evaluated.wall_seconds) | {"seed": evaluated.seed}
    write(folder, summary, draw(summary, evaluated, config), config)
    return summary


def draw(summary: Mapping[str, Any], evaluated: Evaluated, config: Config) -> dict[str, Figure]:
    """Returns the figures named in `CAPTIONS`.

    Args:
      summary: what `results.json` holds.
      evaluated: what `runs.evaluate_run` returned.
      config: the run's config.
    """
    arrays, search = evaluated.arrays, evaluated.search
    threshold = config.env.threshold
    samples = {"random_search": config.random_search.num_samples, "cma_es": config.cma_es.population}
    progress = {name: figures.search_progress(name, arrays[name], samples[name], threshold) for name in samples}
    seen = slice(0, int(search["num_steps"]) + 1)
    return {
        "search": figures.search_strip(search["images"][seen], search["similarity"][seen].tolist(), search["target"]),
        "comparison": figures.comparison(summary),
        **progress,
        "sac_evaluation": figures.policy_episodes(arrays["sac"]),
        "training": figures.training(evaluated.lines, config),
        "reachability": figures.reachability(evaluated.reach),
    }


def write(folder: Path, summary: Mapping[str, Any], pictures: Mapping[str, Figure], config: Config) -> None:
    """Writes results.json, figures/*.png and report.html into `folder`, over those that are there.

    Args:
      folder: the run's folder.
      summary: what `results.json` is to hold.
      pictures: figures by file name, from `draw`.
      config: the run's config.

    Raises:
      OSError: the disk is full or not writable.
    """
    text = json.dumps(summary, indent=2, allow_nan=False) + "\n"  # before anything is written over
    (folder / "figures").mkdir(exist_ok=True)
    images = {name: to_png(picture) for name, picture in pictures.items()}
    for name, image in images.items():
        atomic.write_atomically(folder / "figures" / f"{name}.png", image)
    atomic.write_atomically(folder / "report.html", _page(folder.absolute().name, summary, images, config))
    # The last one: where it is, the report is whole.
    atomic.write_atomically(folder / "results.json", text)


@styled
def to_png(picture: Figure) -> bytes:
    """Returns the picture as a PNG file."""
    buffer = io.BytesIO()
    picture.savefig(buffer, format="png")
    return buffer.getvalue()


def _page(title: str, summary: Mapping[str, Any], images: Mapping[str, bytes], config: Config) -> str:
    loader = jinja2.PackageLoader("vsearch_jax.report", "")
    template = jinja2.Environment(loader=loader, autoescape=True, undefined=jinja2.StrictUndefined).get_template(
        "page.html"
    )
    pictures = [(CAPTIONS[name], base64.b64encode(image).decode()) for name, image in images.items()]
    return template.render(
        title=title,
        searchers=SEARCHERS.values(),
        rows=rows(summary),
        footnote=FOOTNOTE,
        how=regime(summary),
        seeds=summary["sac"]["seeds"],
        pictures=pictures,
        results=summary,
        config=json.dumps(config.to_dict(), indent=2),
    )
