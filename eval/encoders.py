"""Compares the encoder's losses: `python eval/encoders.py --out DIR [--objects NAME ...] [--losses LOSS ...]`.

Trains an encoder for each object, loss and seed, all for about equal time, and measures how well its codes tell views
apart. Each result is kept in DIR at once, and the same command continues an interrupted one. DIR then holds
encoders.json and encoders.md. `--quick` does all of it in small, as a test. `--runs RUN ...` measures the encoders of
finished runs instead.
"""

from __future__ import annotations

import argparse
import dataclasses
import functools
import json
import os
import shlex
import sys
import time
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

os.environ.setdefault("JAX_PLATFORMS", "cpu")  # before jax is imported

import jax
import numpy as np
from jax.stages import Compiled

import vsearch_jax as vs
from encoder_sections.images import FULL, QUICK, encode_views, train_encoder
from encoder_sections.measures import measure
from parts import PARTS, write_part
from vsearch_jax import report, runs
from vsearch_jax.cli.errors import one_line_errors
from vsearch_jax.types import EncoderState, ReachabilityMap

LOSSES = {
    "pose": vs.Config.preset("cpu").encoder,
    "autoencoder": vs.Config.preset("autoencoder").encoder,
    "both": dataclasses.replace(vs.Config.preset("cpu").encoder, loss="both", num_updates=260),
}
"""Encoder's config by the name of the row. The numbers of updates take about equal time; each row holds its seconds."""
OBJECTS = ("teapot", "truck", "bracket", "part:plate", "part:bracket", "part:gear")
SHOWN = {
    "false_match_rate": ("matches > 10° off (%)", 100.0),
    "targets_with_false_match_rate": ("targets with one (%)", 100.0),
    "match_angle_deg_median": ("angle of matches, median (°)", 1.0),
    "threshold_angle_deg_azimuth": ("angle at the threshold: azimuth (°)", 1.0),
    "threshold_angle_deg_elevation": ("elevation (°)", 1.0),
    "basin_share": ("basin (%)", 100.0),
    "basin_share_far": ("basin from ≥ 150° (%)", 100.0),
    "far_cosine_max_mean": ("best cosine > 20° off", 1.0),
    "arm_cosine_change_percent": ("arm: cosine (%)", 1.0),
    "arm_pose_change_deg": ("arm: pose (°)", 1.0),
    "light_pose_change_deg": ("light (°)", 1.0),
    "occlusion_pose_change_deg": ("occlusion (°)", 1.0),
    "shift_pose_change_deg": ("camera shift (°)", 1.0),
    "noise_pose_change_deg": ("noise (°)", 1.0),
    "blur_pose_change_deg": ("blur (°)", 1.0),
    "train_seconds": ("time (s)", 1.0),
}


def main(arguments: list[str]) -> None:
    """Trains and measures what is not done yet, and writes the tables."""
    parser = argparse.ArgumentParser(description="Compares the encoder's losses.")
    parser.add_argument("--out", type=Path, required=True, help="folder of the results; also of an interrupted command")
    parser.add_argument(
        "--objects", nargs="+", default=OBJECTS, help="names or files; part:NAME is one of eval/parts.py"
    )
    parser.add_argument("--losses", nargs="+", default=tuple(LOSSES), choices=tuple(LOSSES))
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--runs", nargs="+", type=Path, default=(), help="measure the encoders of these runs instead")
    parser.add_argument("--quick", action="store_true", help="small sizes, for a test")
    options = parser.parse_args(arguments)
    rows = options.out / "rows"
    rows.mkdir(parents=True, exist_ok=True)
    for run in options.runs:
        _measure_run(run, rows / f"{'-'.join(run.resolve().parts[-2:])}.json", options.quick)
    for name in () if options.runs else options.objects:
        for loss in options.losses:
            for seed in range(options.seeds):
                path = rows / f"{Path(name).stem.replace(':', '-')}-{loss}-{seed}.json"
                if path.is_file():
                    continue
                row = {"object": name, "loss": loss, "seed": seed}
                row |= measure_encoder(_config(name, loss, options.out, options.quick), seed, options.quick)
                runs.write_atomically(path, json.dumps(row, indent=1) + "\n")
                print(f"{name}, {loss}, seed {seed}: {row['train_seconds']:.0f} s", flush=True)
    found = [json.loads(path.read_text(encoding="utf-8")) for path in sorted(rows.glob("*.json"))]
    command = shlex.join(["python", "eval/encoders.py", *arguments])
    content = {"command": command, **report.provenance(), "rows": found}
    runs.write_atomically(options.out / "encoders.json", json.dumps(content, indent=1) + "\n")
    runs.write_atomically(options.out / "encoders.md", to_markdown(content))
    print(f"wrote {options.out / 'encoders.md'}")


def _measure_run(run: Path, path: Path, is_quick: bool) -> None:
    """Measures the encoder of a run, whose encoder stage is done, and keeps the result in the file `path`."""
    if path.is_file():
        return
    config = runs.read_config(run)
    state = runs.resume_run(run, config)
    if int(state.step) < config.encoder.num_updates:
        raise SystemExit(f"--runs {run}: its encoder is not trained yet; first: vsearch train --out {run} --resume")
    lines = runs.read_metrics(run)
    seconds = sum(line["seconds"] for line in lines if line["stage"] == "encoder")
    row = {"object": Path(config.scene.object).name, "loss": config.encoder.loss, "seed": runs.read_seed(run)}
    row |= _measure(state.encoder, state.reach, config, runs.read_seed(run), is_quick)
    row |= {"train_seconds": seconds, "num_updates": config.encoder.num_updates}
    runs.write_atomically(path, json.dumps(row, indent=1) + "\n")


def _config(name: str, loss: str, out: Path, is_quick: bool) -> vs.Config:
    """Returns the config of one training; writes the part's file if the object is one of `eval/parts.py`."""
    config = vs.Config.preset("smoke" if is_quick else "cpu")
    scene = dataclasses.replace(config.scene, object=name)
    if name.startswith("part:"):
        part = name.removeprefix("part:")
        if part not in PARTS:
            raise SystemExit(
                f"--objects {name}: no such part; allowed: {', '.join(f'part:{known}' for known in PARTS)}"
            )
        path = write_part(part, out / "parts")
        scene = dataclasses.replace(config.scene, object=str(path), mesh_scale=0.001)
    encoder = dataclasses.replace(config.encoder, loss=loss) if is_quick else LOSSES[loss]
    return dataclasses.replace(config, scene=scene, encoder=encoder)


def measure_encoder(config: vs.Config, seed: int, is_quick: bool) -> dict[str, float]:
    """Trains one encoder, and returns its measures and the seconds of its training without compilation.

    Args:
      config: the run's config.
      seed: seed of all random numbers.
      is_quick: small sizes.
    """
    compiled, reach = _compile_training(config)
    began = time.perf_counter()
    encoder = jax.block_until_ready(compiled(jax.random.key(seed), reach))
    seconds = time.perf_counter() - began
    measured = _measure(encoder, reach, config, seed, is_quick)
    return measured | {"train_seconds": seconds, "num_updates": config.encoder.num_updates}


@functools.lru_cache(maxsize=1)
def _compile_training(config: vs.Config) -> tuple[Compiled, ReachabilityMap]:
    """Compiles the training of `config` for all seeds. What was compiled for another config is released."""
    jax.clear_caches()
    reach = vs.ViewSearchEnv(config).reach
    return train_encoder.lower(jax.random.key(0), reach, config).compile(), reach


def _measure(
    encoder: EncoderState, reach: ReachabilityMap, config: vs.Config, seed: int, is_quick: bool
) -> dict[str, float]:
    """Returns the measures of a trained encoder."""
    key = jax.random.fold_in(jax.random.key(seed), 1)
    codes = encode_views(key, encoder, reach, config, QUICK if is_quick else FULL)
    low, high = np.rad2deg(np.asarray(reach.band))
    symmetry = vs.build_scene(config.scene).symmetry
    return measure(codes, float(high - low), symmetry, config.env.threshold)


def to_markdown(content: Mapping[str, Any]) -> str:
    """Returns the tables: means over the seeds for each object and loss, then over all objects.

    Args:
      content: what `encoders.json` holds.
    """
    lines = ["# Losses of the encoder", "", f"Written by `{content['command']}`. Means over the seeds.", ""]
    lines += ["Each loss has the network and the optimizer that suit it. They differ from the preset `cpu` in:", ""]
    usual = LOSSES["pose"]
    for name, encoder in LOSSES.items():
        differing = [f for f in dataclasses.fields(encoder) if getattr(encoder, f.name) != getattr(usual, f.name)]
        text = ", ".join(f"{f.name} {getattr(encoder, f.name)}" for f in differing)
        lines.append(f"- `{name}`: {text or 'nothing'}.")
    lines.append("")
    lines += [f"| object | loss | seeds | {' | '.join(label for label, _ in SHOWN.values())} |"]
    lines += ["|---" * (len(SHOWN) + 3) + "|"]
    groups: dict[tuple[str, str], list[dict[str, Any]]] = {}
    for row in content["rows"]:
        groups.setdefault((row["object"], row["loss"]), []).append(row)
    for (name, loss), rows in groups.items():
        lines.append(_line(name, loss, rows))
    for loss in dict.fromkeys(loss for _, loss in groups):
        lines.append(_line("**all**", loss, [row for row in content["rows"] if row["loss"] == loss]))
    return "\n".join(lines) + "\n"


def _line(name: str, loss: str, rows: Iterable[Mapping[str, Any]]) -> str:
    rows = list(rows)
    cells = [f"{scale * np.nanmean([row[key] for row in rows]):.3g}" for key, (_, scale) in SHOWN.items()]
    seeds = len({row["seed"] for row in rows})
    return f"| {name} | {loss} | {seeds} | {' | '.join(cells)} |"


if __name__ == "__main__":
    with one_line_errors():
        main(sys.argv[1:])
