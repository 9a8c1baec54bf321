"""Every table and figure of the thesis's chapter 5 by one command: `python eval/thesis.py --out DIR [--run RUN]`.

The encoder comes from a finished run. Without `--run` it is trained in DIR/run first. Each part is written as soon as
it is done. The same command continues an interrupted one. `--quick` does all of it in small, as a test.

DIR then holds thesis.md, thesis.json and figures/; arrays/ holds the measures of every trial.
"""

from __future__ import annotations

import argparse
import dataclasses
import hashlib
import json
import os
import shlex
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

os.environ.setdefault("JAX_PLATFORMS", "cpu")  # before jax is imported

import jax
import numpy as np
from matplotlib.figure import Figure

import vsearch_jax as vs
from thesis_sections import figures, policy, tables
from thesis_sections.searches import experiments, run_experiment
from vsearch_jax import report, runs
from vsearch_jax.cli.errors import one_line_errors
from vsearch_jax.types import TrainState

Arrays = dict[str, dict[str, np.ndarray]]
"""{label of a searcher: {measure: array}}."""


def main(arguments: list[str]) -> None:
    """Runs what is not done yet, and writes tables, figures and page."""
    parser = argparse.ArgumentParser(description="Writes every table and figure of the thesis's chapter 5.")
    parser.add_argument("--out", type=Path, required=True, help="folder of the results; also of an interrupted command")
    parser.add_argument("--run", type=Path, help="finished run that gives the encoder; trained in DIR/run by default")
    parser.add_argument("--preset", default="cpu", help="preset of the run that is trained")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--quick", action="store_true", help="small sizes, for a test")
    options = parser.parse_args(arguments)
    options.out.mkdir(parents=True, exist_ok=True)

    if options.run and runs.latest_step(options.run) is None:
        parser.error(f"--run {options.run}: holds no run; name the folder of a run, or leave the option out")
    run = options.run or options.out / "run"
    state, config = _trained_run(run, options.preset, options.seed, options.quick)
    _check_same_encoder(options.out, run, state, config, options.quick)
    band = np.rad2deg(np.asarray(state.reach.band))
    num_runs = 2 if options.quick else 10
    searches = {
        name: _kept(options.out, name, lambda one=one: run_experiment(state, config, one))
        for name, one in experiments(config, (band[0], band[1]), num_runs).items()
    }
    thesis_config = policy.thesis_config(config, options.quick)

    def thesis_policies() -> Arrays:
        trained = policy.train_policies(options.out / "sac", state, thesis_config, options.seed)
        return {"sac": policy.evaluate_policies(trained, thesis_config)}

    policies = _kept(options.out, "policies", thesis_policies)["sac"]
    lines = runs.read_metrics(options.out / "sac")
    drawn = _draw_figures(searches, policies, state, config, lines, thesis_config)
    content = {
        "command": shlex.join(["python", "eval/thesis.py", *arguments]),
        "encoder": f"loss {config.encoder.loss}, {config.encoder.num_updates} updates, object {config.scene.object}",
        "table_5_1": tables.table_5_1(searches["k_sweep"]),
        "searchers": tables.searcher_rows(searches["repeats"] | {"sac": policies}),
        "wide_sweep": tables.wide_sweep(searches["wide_sweep"]),
        "table_5_2": tables.table_5_2(searches["penalty"]),
        "config": config.to_dict(),
        "thesis_policy_config": thesis_config.to_dict(),
        **report.provenance(),
    }
    _write(options.out, content, drawn)
    print(f"wrote {options.out / 'thesis.md'}")


def _trained_run(run: Path, preset: str, seed: int, is_quick: bool) -> tuple[TrainState, vs.Config]:
    """Returns the state and the config of a finished run; trains the run first, or to its end, where necessary."""
    if runs.latest_step(run) is None:
        config = vs.Config.preset("smoke" if is_quick else preset)
        if is_quick:
            encoder = dataclasses.replace(config.encoder, input="silhouette")
            config = dataclasses.replace(config, encoder=encoder)
        state = runs.start_run(run, config, seed)
    else:
        config = runs.read_config(run)
        state = runs.resume_run(run, config)
    return runs.train_to_end(run, state, config), config


def _check_same_encoder(out: Path, run: Path, state: TrainState, config: vs.Config, is_quick: bool) -> None:
    """Notes in DIR which encoder its results are of. Ends the command if DIR holds results of another one."""
    leaves = b"".join(np.asarray(leaf).tobytes() for leaf in jax.tree.leaves(state.encoder))
    mine = {"encoder_sha256": hashlib.sha256(leaves).hexdigest(), "config": config.to_dict(), "is_quick": is_quick}
    text, path = json.dumps(mine, indent=1) + "\n", out / "encoder.json"
    if path.is_file() and path.read_text(encoding="utf-8") != text:
        raise SystemExit(f"--out {out} holds results of another encoder than that of {run}; name another folder")
    runs.write_atomically(path, text)


def _kept(out: Path, name: str, compute: Callable[[], Arrays]) -> Arrays:
    """Returns the arrays of a part from out/arrays; computes and keeps them if they are not there."""
    path = out / "arrays" / f"{name}.npz"
    if not path.is_file():
        print(f"{name} …", flush=True)
        arrays = {f"{label}/{key}": x for label, values in compute().items() for key, x in values.items()}
        path.parent.mkdir(exist_ok=True)
        with runs.replace_file(path) as new, new.open("wb") as file:
            np.savez_compressed(file, allow_pickle=False, **arrays)
    kept: Arrays = {}
    with np.load(path) as arrays:
        for full in arrays.files:
            label, key = full.split("/")
            kept.setdefault(label, {})[key] = arrays[full]
    return kept


def _draw_figures(
    searches: Mapping[str, Arrays],
    policies: dict[str, np.ndarray],
    state: TrainState,
    config: vs.Config,
    lines: list[dict[str, Any]],  # lines of metrics.jsonl
    thesis_config: vs.Config,
) -> dict[str, Figure]:
    """Returns the figures by their number in the thesis."""
    drawn = {"3.1": report.draw_reachability(state.reach)}
    for measure in range(3):
        drawn[f"5.{1 + measure}"] = figures.draw_k_sweep(searches["k_sweep"], measure)
        for first, name in ((4, "random_search"), (7, "cma_es")):
            arrays = searches["repeats"][name]
            drawn[f"5.{first + measure}"] = figures.draw_runs(name, arrays, measure, config.env.threshold)
    drawn["5.10"] = figures.draw_comparison(searches["repeats"])
    drawn["5.11"] = figures.draw_unreachable(searches["penalty"], config.cma_es.population)
    drawn["5.12"] = figures.draw_policy_training(lines, config.encoder.num_updates, thesis_config.sac.num_envs)
    drawn["5.13"] = figures.draw_policy_evaluation(policies)
    return drawn


def _write(out: Path, content: Mapping[str, Any], drawn: Mapping[str, Figure]) -> None:
    """Writes figures, thesis.json and thesis.md."""
    (out / "figures").mkdir(exist_ok=True)
    for number, figure in drawn.items():
        runs.write_atomically(out / "figures" / tables.figure_name(number), report.to_png(figure))
    runs.write_atomically(out / "thesis.json", json.dumps(content, indent=1) + "\n")
    runs.write_atomically(out / "thesis.md", tables.to_markdown(content))


if __name__ == "__main__":
    with one_line_errors():
        main(sys.argv[1:])
