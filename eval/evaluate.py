"""Evaluates the checkpoint of a finished run in batches, by the Python API: an example to copy.

    python eval/evaluate.py runs/first --episodes 3000 --target 120 50 --out runs/first-120-50

The checkpoint may come from any platform; the evaluation runs on the CPU unless JAX_PLATFORMS says otherwise.
"""

from __future__ import annotations

import argparse
import dataclasses
import os
import time
from pathlib import Path

os.environ.setdefault("JAX_PLATFORMS", "cpu")  # before jax is imported

import jax
import numpy as np

import vsearch_jax as vs
from vsearch_jax import report, runs
from vsearch_jax.cli.errors import one_line_errors
from vsearch_jax.evaluation import record_search
from vsearch_jax.search import LABELS


def evaluate(run: Path, out: Path, episodes: int, target_deg: tuple[float, float], batch_size: int) -> None:
    """Evaluates every searcher of a run and writes results.json, figures and report.html into `out`.

    Args:
      run: folder of a finished run.
      out: folder of the results; must be empty or not exist.
      episodes: episodes of each policy.
      target_deg: azimuth and elevation of the target view of random search and CMA-ES, in degrees.
      batch_size: episodes that run side by side.
    """
    config = runs.read_config(run)
    state = runs.resume_run(run, config)
    runs.check_finished(run, state, config)
    runs.make_new_folder(out)
    settings = dataclasses.replace(
        config.evaluation,
        num_episodes=episodes,
        batch_size=batch_size,
        target_azimuth_deg=target_deg[0],
        target_elevation_deg=target_deg[1],
    )
    config = dataclasses.replace(config, evaluation=settings)

    began = time.perf_counter()
    arrays = vs.evaluate(state, config)
    seconds = time.perf_counter() - began
    search = jax.tree.map(np.asarray, record_search(state, config))
    lines = runs.read_metrics(run)
    evaluated = runs.Evaluated(arrays, search, state.reach, lines, {"evaluation": seconds}, runs.read_seed(run))
    results = report.write_report(out, evaluated, config)
    for name in LABELS:
        ours = results[name]
        print(f"{name}: pose success {ours['pose_success_rate']:.3f}, {ours['evaluations_mean']:.1f} images")
    print(f"{seconds:.1f} s, compilation included; wrote {out / 'report.html'}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Evaluates a finished run.")
    parser.add_argument("run", type=Path, help="folder of a finished run")
    parser.add_argument("--out", type=Path, required=True, help="folder of the results")
    parser.add_argument("--episodes", type=int, default=1000)
    parser.add_argument("--target", type=float, nargs=2, default=(60.0, 55.0), metavar=("AZIMUTH", "ELEVATION"))
    parser.add_argument("--batch-size", type=int, default=125)
    options = parser.parse_args()
    with one_line_errors():
        evaluate(options.run, options.out, options.episodes, tuple(options.target), options.batch_size)
