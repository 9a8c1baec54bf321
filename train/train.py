"""One run from a preset to a checkpoint and a report, by the Python API: an example to copy.

    python train/train.py --preset smoke --out runs/example

`vsearch train` does the same and adds progress, interrupts and `--resume`.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import jax
import numpy as np

import vsearch_jax as vs
from vsearch_jax import report, runs
from vsearch_jax.cli.errors import one_line_errors
from vsearch_jax.evaluation import record_search
from vsearch_jax.search import LABELS


def train(folder: Path, config: vs.Config, seed: int) -> None:
    """Trains, saving after each chunk, and writes results.json, figures and report.html.

    Args:
      folder: folder of the run; must be empty or not exist.
      config: the run's config.
      seed: of all random numbers of the run.
    """
    state = runs.start_run(folder, config, seed)  # makes the folder, calls `vs.init`, saves the first checkpoint
    log = runs.MetricsLog(folder, step=0)
    step = 0
    while step < config.num_iterations:
        began = time.perf_counter()
        state, metrics = vs.train(state, config)  # one chunk; `config.num_chunks` of them are the run
        done = int(state.step)
        seconds = time.perf_counter() - began
        # The last chunk may be shorter than its arrays.
        log.append({name: np.asarray(x)[: done - step] for name, x in metrics.items()}, step, seconds)
        runs.save(folder, state, config)
        print(f"{done}/{config.num_iterations} iterations, {seconds:.1f} s")
        step = done
    log.close()

    began = time.perf_counter()
    arrays = vs.evaluate(state, config)  # every searcher, all trials in one jitted call
    wall_seconds: dict[str, float] = {
        stage: sum(line["seconds"] for line in log.lines if line["stage"] == stage) for stage in ("encoder", "policy")
    }
    wall_seconds["evaluation"] = time.perf_counter() - began
    evaluated = runs.Evaluated(
        arrays=arrays,
        search=jax.tree.map(np.asarray, record_search(state, config)),
        reach=state.reach,
        lines=log.lines,
        wall_seconds=wall_seconds,
        seed=seed,
    )
    results = report.write_report(folder, evaluated, config)
    for name in LABELS:
        ours = results[name]
        print(f"{name}: pose success {ours['pose_success_rate']:.3f}, {ours['evaluations_mean']:.1f} images")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Trains and evaluates one run.")
    parser.add_argument("--preset", default="cpu")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    with one_line_errors():
        train(options.out, vs.Config.preset(options.preset), options.seed)
