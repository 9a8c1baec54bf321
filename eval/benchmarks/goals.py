"""Share of views that have a path, by the number of IK solutions tried: `python eval/benchmarks/goals.py --arm ur5e`.

Draws pairs of random views. The arm starts at joints that reach the first one. The second is wanted.
"""

from __future__ import annotations

import argparse
import dataclasses
import functools
import os

os.environ.setdefault("JAX_PLATFORMS", "cpu")  # before jax is imported

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

import vsearch_jax as vs
from vsearch_jax.config import Config
from vsearch_jax.types import ReachabilityMap
from vsearch_jax.xla.batching import map_in_batches

_BATCH = 50


def main() -> None:
    """Measures, and prints one line for each number of solutions."""
    parser = argparse.ArgumentParser(description="Share of views that have a path.")
    parser.add_argument("--arm", default="ur5e", help="name of an arm in xml/arm, or MJCF file")
    parser.add_argument("--count", type=int, default=500, help="number of views")
    parser.add_argument("--goals", type=int, nargs="+", default=[1, 2, 3], help="numbers of IK solutions")
    options = parser.parse_args()
    config = vs.Config.preset("smoke")
    config = dataclasses.replace(
        config,
        scene=dataclasses.replace(config.scene, arm=options.arm),
        ik=vs.Config.preset("cpu").ik,
        env=dataclasses.replace(config.env, reachable="path"),
    )
    reach = vs.ViewSearchEnv(config).reach
    for num_goals in options.goals:
        planning = dataclasses.replace(config.planning, num_goals=num_goals)
        has_joints, has_path = (
            np.asarray(found)
            for found in find_paths(reach, dataclasses.replace(config, planning=planning), options.count)
        )
        print(
            f"{num_goals} solutions: {has_joints.sum()} of {options.count} views have joints, "
            f"{(has_joints & ~has_path).sum()} of these no path ({100 * (1 - has_path[has_joints].mean()):.1f} %)",
            flush=True,
        )


@functools.partial(jax.jit, static_argnames=("config", "count"))
def find_paths(reach: ReachabilityMap, config: Config, count: int) -> tuple[Array, Array]:
    """Returns for N random views whether IK finds joints, and whether a path leads to one of its solutions, bool[N].

    Args:
      reach: the views that the arm reaches.
      config: the run's config.
      count: number of views N.
    """
    env = vs.ViewSearchEnv(config, reach=reach)

    def find(key: Array) -> tuple[Array, Array]:
        start_key, view_key = jax.random.split(key)
        _, start = env.random_end(start_key, jnp.bool_(False))
        view, _ = env.random_view(view_key)
        return env.solve_joints(view, start)[1], env.move_to_view(view, start)[1].is_found

    return map_in_batches(find, jax.random.split(jax.random.key(0), count), _BATCH)


if __name__ == "__main__":
    main()
