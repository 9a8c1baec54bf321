"""Writes a run's results.json, figures and a self-contained page that shows them."""

from __future__ import annotations

import base64
import io
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jinja2
from matplotlib.figure import Figure

from vsearch_jax import run_folder
from vsearch_jax.config import Config
from vsearch_jax.report import figures
from vsearch_jax.report.style import styled
from vsearch_jax.report.summary import SEARCHERS
from vsearch_jax.report.table import FOOTNOTE, regime, rows
from vsearch_jax.types import ReachabilityMap

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


def draw(
    results: Mapping[str, Any],
    arrays: Mapping[str, Any],
    search: Mapping[str, Any],
    reach: ReachabilityMap,
    lines: Sequence[Mapping[str, Any]],
    config: Config,
) -> dict[str, Figure]:
    """Returns the figures named in `CAPTIONS`.

    Args:
      results: what `results.json` holds.
      arrays: what `evaluate` returned.
      search: what `record_search` returned.
      reach: the arm's reachability map.
      lines: the lines of metrics.jsonl.
      config: the run's config.
    """
    threshold = config.env.threshold
    samples = {"random_search": config.random_search.num_samples, "cma_es": config.cma_es.population}
    progress = {name: figures.search_progress(name, arrays[name], samples[name], threshold) for name in samples}
    seen = slice(0, int(search["num_steps"]) + 1)
    return {
        "search": figures.search_strip(search["images"][seen], search["similarity"][seen], search["target"]),
        "comparison": figures.comparison(results),
        **progress,
        "sac_evaluation": figures.policy_episodes(arrays["sac"]),
        "training": figures.training(lines, config),
        "reachability": figures.reachability(reach),
    }


def write(folder: Path, results: Mapping[str, Any], pictures: Mapping[str, Figure], config: Config) -> None:
    """Writes results.json, figures/*.png and report.html into `folder`, over those that are there.

    Args:
      folder: the run's folder.
      results: what `results.json` is to hold.
      pictures: figures by file name, from `draw`.
      config: the run's config.

    Raises:
      OSError: the disk is full or not writable.
    """
    text = json.dumps(results, indent=2, allow_nan=False) + "\n"  # before anything is written over
    (folder / "figures").mkdir(exist_ok=True)
    images = {name: png(picture) for name, picture in pictures.items()}
    for name, image in images.items():
        run_folder.write(folder / "figures" / f"{name}.png", image)
    run_folder.write(folder / "report.html", _page(folder.absolute().name, results, images, config))
    # The last one: where it is, the report is whole.
    run_folder.write(folder / "results.json", text)


@styled
def png(picture: Figure) -> bytes:
    """Returns the picture as a PNG file."""
    buffer = io.BytesIO()
    picture.savefig(buffer, format="png")
    return buffer.getvalue()


def _page(title: str, results: Mapping[str, Any], images: Mapping[str, bytes], config: Config) -> str:
    loader = jinja2.PackageLoader("vsearch_jax.report", "")
    template = jinja2.Environment(loader=loader, autoescape=True, undefined=jinja2.StrictUndefined).get_template(
        "page.html"
    )
    pictures = [(CAPTIONS[name], base64.b64encode(image).decode()) for name, image in images.items()]
    return template.render(
        title=title,
        searchers=SEARCHERS.values(),
        rows=rows(results),
        footnote=FOOTNOTE,
        how=regime(results),
        seeds=results["sac"]["seeds"],
        pictures=pictures,
        results=results,
        config=json.dumps(config.to_dict(), indent=2),
    )
