"""Compares `ik` with mink and `rrt_connect` with OMPL in one run: `python eval/benchmarks/planning.py`.

Both planners get the same problems; half of these need a detour. Both are judged by the same check: contacts by C
MuJoCo, with the table's clearance as the table's margin. OMPL calls this check for every configuration. `rrt_connect`
proves its paths free with its own distances; the check is applied to its result only. Install the extra `benchmark`.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from typing import TypeVar

import jax
import numpy as np

from planning_peers import SPACING, Checker, OmplSolution, silence_ompl, solve_mink, solve_ompl
from vsearch_jax.config import IKConfig, PlanningConfig, SceneConfig
from vsearch_jax.planning import edge_is_free, ik, rrt_connect
from vsearch_jax.robot.arm import Arm, build_arm, camera_pose, forward_kinematics
from vsearch_jax.scene import build_scene

Result = TypeVar("Result")

# mink solves one pose after another, so it gets fewer.
MAX_MINK_POSES = 500


def length(path: np.ndarray) -> float:
    """Returns the Euclidean length in rad of a path f64[W, J]."""
    return float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum())


def timed(run: Callable[[], Result], repeats: int = 3) -> tuple[Result, float]:
    """Returns the result of `run` and its shortest time in seconds. The first call compiles and is not timed.

    Args:
      run: returns a pytree of arrays.
      repeats: number of timed calls.
    """
    result, best = jax.block_until_ready(run()), float("inf")
    for _ in range(repeats):
        start = time.perf_counter()
        jax.block_until_ready(run())
        best = min(best, time.perf_counter() - start)
    return result, best


def random_joints(arm: Arm, seed: int, count: int) -> np.ndarray:
    """Returns f32[count, nq] rad or m, random inside the limits. Joints outside the chain are at home.

    Args:
      arm: the arm.
      seed: of the random numbers.
      count: number of configurations.
    """
    joints = np.random.default_rng(seed).uniform(arm.lower, arm.upper, (count, len(arm.lower))).astype(np.float32)
    others = np.setdiff1d(np.arange(joints.shape[1]), arm.chain.address)
    joints[:, others] = np.asarray(arm.home)[others]
    return joints


def benchmark_ik(num_poses: int) -> None:
    """Prints success rate and speed of `ik` and mink on random reachable poses."""
    scene = build_scene(SceneConfig())
    arm, config = build_arm(scene), IKConfig()
    wanted, present = random_joints(arm, 1, num_poses), random_joints(arm, 2, num_poses)
    poses = jax.jit(jax.vmap(lambda q: camera_pose(arm, forward_kinematics(arm, q))))(wanted)
    solve = jax.jit(jax.vmap(lambda pose, q: ik(arm, pose, q, config)))
    result, seconds = timed(lambda: solve(poses, present))
    rate = num_poses / seconds
    num_mink = min(num_poses, MAX_MINK_POSES)
    start = time.perf_counter()
    solved = np.mean([solve_mink(scene, wanted[i], present[i], config) for i in range(num_mink)])
    mink_rate = num_mink / (time.perf_counter() - start)
    is_inside = np.all((result.qpos >= arm.lower[None]) & (result.qpos <= arm.upper[None]))
    print(
        f"IK, {num_poses} poses: ours solves {float(result.is_converged.mean()):.4f} at {rate:,.0f}/s, "
        f"all inside the limits: {is_inside}"
    )
    print(
        f"IK, {num_mink} poses: mink solves {solved:.4f} at {mink_rate:,.0f}/s; ratio {rate / mink_rate:.1f}",
        flush=True,
    )


def make_problems(arm: Arm, checker: Checker, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Returns starts and goals f32[count, nq]. Straight paths are free in the first half, blocked in the second.

    Args:
      arm: the arm.
      checker: of the arm's scene.
      count: number of problems.
    """
    address, config = np.asarray(arm.chain.address), PlanningConfig()
    joints = random_joints(arm, 5, 16 * count)
    joints = joints[[checker.is_free(q[address]) for q in joints]]
    half = len(joints) // 2
    start, goal = joints[:half], joints[half : 2 * half]
    is_free = np.asarray(jax.jit(jax.vmap(lambda a, b: edge_is_free(arm, a, b, config)))(start, goal))
    is_blocked = np.array(
        [not checker.is_path_free(np.stack(ends)[:, address], SPACING) for ends in zip(start, goal, strict=True)]
    )
    chosen = np.concatenate([np.flatnonzero(is_free)[: count // 2], np.flatnonzero(is_blocked)[: count - count // 2]])
    return start[chosen], goal[chosen]


def benchmark_rrt(num_problems: int) -> None:
    """Prints success rates, path lengths and speeds of both planners, for all problems and for the detours alone."""
    scene = build_scene(SceneConfig(obstacles="posts"))
    arm, config = build_arm(scene), PlanningConfig()
    checker = Checker(scene, np.asarray(arm.home))
    start, goal = make_problems(arm, checker, num_problems)
    num_problems, address = len(start), np.asarray(arm.chain.address)
    plan = jax.jit(jax.vmap(lambda key, a, b: rrt_connect(arm, key, a, b, config)))
    keys = jax.random.split(jax.random.key(0), num_problems)
    theirs = [solve_ompl(arm, checker, a, b) for a, b in zip(start, goal, strict=True)]
    for name, part in (("all", slice(None)), ("detours", slice(num_problems // 2, None))):
        paths, seconds = timed(lambda part=part: plan(keys[part], start[part], goal[part]))
        found = np.asarray(paths.status) == 0
        waypoints = np.asarray(paths.waypoints)[:, :, address]
        ours = [path if is_found else None for path, is_found in zip(waypoints, found, strict=True)]
        print_comparison(name, checker, ours, seconds, theirs[part])


def print_comparison(
    name: str, checker: Checker, ours: list[np.ndarray | None], seconds: float, theirs: list[OmplSolution]
) -> None:
    """Prints one line of the comparison.

    Args:
      name: of the set of problems.
      checker: judges both planners' paths.
      ours: path f32[W, J] of each problem, or None if none was found.
      seconds: our time for all problems.
      theirs: OMPL's solutions of the same problems.
    """
    other = [solution.path for solution in theirs]
    ratios = [length(a) / length(b) for a, b in zip(ours, other, strict=True) if a is not None and b is not None]
    (found, free), (other_found, other_free) = (
        (
            np.mean([path is not None for path in paths]),
            np.mean([checker.is_path_free(path, SPACING / 4) for path in paths if path is not None]),
        )
        for paths in (ours, other)
    )
    count = len(ours)
    planning = sum(solution.planning_seconds for solution in theirs)
    total = sum(solution.total_seconds for solution in theirs)
    print(
        f"{name}, {count} problems: found {found:.3f}, OMPL {other_found:.3f}; free on a dense check {free:.3f}, OMPL "
        f"{other_free:.3f}; median length / OMPL's {np.median(ratios):.3f}; ours {count / seconds:,.0f}/s, OMPL "
        f"{count / planning:,.1f}/s ({count / total:,.1f}/s with simplification); ratio {planning / seconds:.1f} "
        f"({total / seconds:.1f})",
        flush=True,
    )


def main() -> None:
    """Runs both comparisons."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--poses", type=int, default=2000, help="number of IK problems")
    parser.add_argument("--problems", type=int, default=200, help="number of planning problems")
    parser.add_argument("--skip-ik", action="store_true", help="run the planning comparison only")
    arguments = parser.parse_args()
    silence_ompl()
    if not arguments.skip_ik:
        benchmark_ik(arguments.poses)
    benchmark_rrt(arguments.problems)


if __name__ == "__main__":
    main()
