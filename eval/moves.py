"""How exactly the arm's simulated dynamics follow planned motions: `python eval/moves.py --out FILE.json`.

Draws random pairs of reachable views, plans a motion between them, simulates the arm along it (MJX, position
actuators), and measures how far the wrist camera comes to rest from where the plan ends.
"""

from __future__ import annotations

import argparse
import dataclasses
import functools
import json
import os
import shlex
import sys
from pathlib import Path

os.environ.setdefault("JAX_PLATFORMS", "cpu")  # before jax is imported

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

import vsearch_jax as vs
from vsearch_jax import report, runs
from vsearch_jax.cli.errors import one_line_errors
from vsearch_jax.config import Config
from vsearch_jax.planning.execution import execute
from vsearch_jax.types import ReachabilityMap
from vsearch_jax.xla.batching import map_in_batches

_BATCH = 25


def main(arguments: list[str]) -> None:
    """Measures, and writes the JSON file."""
    parser = argparse.ArgumentParser(description="Measures how exactly the dynamics follow planned motions.")
    parser.add_argument("--out", type=Path, required=True, help="JSON file to write")
    parser.add_argument("--arm", default="lwr", help="name of an arm in xml/arm, or MJCF file")
    parser.add_argument("--count", type=int, default=500, help="number of motions")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args(arguments)
    config = vs.Config.preset("cpu")
    config = dataclasses.replace(
        config,
        scene=dataclasses.replace(config.scene, arm=options.arm),
        env=dataclasses.replace(config.env, reachable="path", motion="dynamic"),
    )
    reach = vs.ViewSearchEnv(config).reach
    is_found, micrometres, seconds = jax.tree.map(
        np.asarray, measure_moves(jax.random.key(options.seed), reach, config, options.count)
    )
    moved = is_found & (seconds > 0.0)
    content = {
        "command": shlex.join(["python", "eval/moves.py", *arguments]),
        **report.provenance(),
        "arm": options.arm,
        "motions": options.count,
        "planned": int(is_found.sum()),
        "rest_error_micrometre_median": float(np.median(micrometres[moved])),
        "rest_error_micrometre_p99": float(np.percentile(micrometres[moved], 99)),
        "rest_error_micrometre_max": float(micrometres[moved].max()),
        "motion_time_s_mean": float(seconds[moved].mean()),
    }
    options.out.parent.mkdir(parents=True, exist_ok=True)
    runs.write_atomically(options.out, json.dumps(content, indent=1) + "\n")
    print(json.dumps(content, indent=1))


@functools.partial(jax.jit, static_argnames=("config", "count"))
def measure_moves(key: Array, reach: ReachabilityMap, config: Config, count: int) -> tuple[Array, Array, Array]:
    """Plans and simulates N random motions between reachable views.

    Args:
      key: PRNG key.
      reach: the views that the arm reaches.
      config: the run's config.
      count: number of motions N.

    Returns:
      bool[N], a path was found; f32[N] micrometres, distance of the camera at rest from the end of the plan; f32[N] s,
      duration of the planned motion.
    """
    env = vs.ViewSearchEnv(config, reach=reach)

    def move(key: Array) -> tuple[Array, Array, Array]:
        start_key, goal_key = jax.random.split(key)
        _, start = env.random_end(start_key, jnp.bool_(False))
        _, goal = env.random_end(goal_key, jnp.bool_(False))
        trajectory, motion = env.plan_motion(start, goal)
        rest = execute(env.arm, env.scene.mjx_model, trajectory, config.planning).qpos
        planned, reached = (env.forward(qpos)[1].position for qpos in (trajectory.waypoints[-1], rest))
        return motion.is_found, 1e6 * jnp.linalg.norm(reached - planned), motion.duration

    return map_in_batches(move, jax.random.split(key, count), _BATCH)


if __name__ == "__main__":
    with one_line_errors():
        main(sys.argv[1:])
