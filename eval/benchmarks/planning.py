"""IK against mink, RRT-Connect against OMPL's, side by side in one run: `python eval/benchmark_planning.py`.

Both planners get the same problems, half of which truly need a detour, and are judged by the same check: C MuJoCo's
contacts, with the table's clearance as the table's margin. OMPL calls it for every configuration; ours is proven free
by its own distances and only checked by it afterwards. Needs the extra `benchmark`.
"""

# OMPL's bindings are not typed: a state is indexed, and setStartAndGoalStates takes two of them.
# pyright: reportIndexIssue=false, reportArgumentType=false

from __future__ import annotations

import argparse
import itertools
import time
from collections.abc import Callable
from typing import Any

import jax
import mink
import mujoco
import numpy as np
from ompl import base, geometric, util  # pyright: ignore[reportMissingImports] # in the extra `benchmark` only

from vsearch_jax.config import IKConfig, PlanningConfig, SceneConfig
from vsearch_jax.planning import edge_is_free, ik, rrt_connect
from vsearch_jax.robot.arm import Arm, build_arm, camera_pose, forward_kinematics
from vsearch_jax.scene import Scene, build_scene

OMPL_SECONDS = 5.0
# OMPL looks at configurations this far apart, in rad; the final check of both at a quarter of it.
SPACING = 0.02
MINK_STEPS = 60


class Checker:
    """Is a configuration free? By C MuJoCo."""

    def __init__(self, scene: Scene, qpos: np.ndarray) -> None:
        self.model = scene.mj_model
        self.model.geom_margin[scene.table_geom_id] = scene.table_clearance
        self.data = mujoco.MjData(self.model)
        self.data.qpos[:] = qpos
        self.address = np.asarray(scene.qpos_addresses)

    def is_free(self, joints: np.ndarray) -> bool:
        """Whether nothing touches at the joints of the chain."""
        self.data.qpos[self.address] = joints
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_collision(self.model, self.data)
        return self.data.ncon == 0

    def is_path_free(self, path: np.ndarray, spacing: float) -> bool:
        """Whether the path is free where it is sampled."""
        for start, end in itertools.pairwise(path):
            steps = int(np.linalg.norm(end - start) / spacing) + 1
            if not all(self.is_free(start + u * (end - start)) for u in np.linspace(0.0, 1.0, steps + 1)):
                return False
        return True


def length(path: np.ndarray) -> float:
    """Returns the Euclidean length in joint space."""
    return float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum())


def timed(run: Callable[[], Any], repeats: int = 3) -> tuple[Any, float]:
    """Returns the result and the least seconds of some repeats, after one that compiles."""
    result, best = jax.block_until_ready(run()), np.inf
    for _ in range(repeats):
        start = time.perf_counter()
        jax.block_until_ready(run())
        best = min(best, time.perf_counter() - start)
    return result, best


def random_joints(arm: Arm, seed: int, count: int) -> np.ndarray:
    """Returns f32[count, nq] inside the limits, the fingers half open."""
    joints = np.random.default_rng(seed).uniform(arm.lower, arm.upper, (count, len(arm.lower))).astype(np.float32)
    others = np.setdiff1d(np.arange(joints.shape[1]), arm.chain.address)
    joints[:, others] = np.asarray(arm.home)[others]
    return joints


def benchmark_ik(num_poses: int) -> None:
    """Prints share solved and rate of both on poses that are reachable by construction."""
    scene = build_scene(SceneConfig())
    arm, config = build_arm(scene), IKConfig()
    wanted, present = random_joints(arm, 1, num_poses), random_joints(arm, 2, num_poses)
    poses = jax.jit(jax.vmap(lambda q: camera_pose(arm, forward_kinematics(arm, q))))(wanted)
    solve = jax.jit(jax.vmap(lambda pose, q: ik(arm, pose, q, config)))
    result, seconds = timed(lambda: solve(poses, present))
    rate = num_poses / seconds
    few = min(num_poses, 500)
    start = time.perf_counter()
    solved = np.mean([_mink(scene, wanted[i], present[i], config) for i in range(few)])
    mink_rate = few / (time.perf_counter() - start)
    is_inside = np.all((result.qpos >= arm.lower[None]) & (result.qpos <= arm.upper[None]))
    print(f"IK, {num_poses} poses: ours {float(result.is_converged.mean()):.4f} at {rate:,.0f}/s, inside {is_inside}")
    print(f"IK, {few} poses: mink {solved:.4f} at {mink_rate:,.0f}/s; ratio {rate / mink_rate:.1f}", flush=True)


def _mink(scene: Scene, wanted: np.ndarray, present: np.ndarray, config: IKConfig) -> bool:
    model = scene.mj_model
    configuration = mink.Configuration(model, q=wanted.astype(float))
    site = model.site(scene.tcp_site_id).name
    target = configuration.get_transform_frame_to_world(site, "site")
    task = mink.FrameTask(site, "site", position_cost=1.0, orientation_cost=0.3, lm_damping=1e-3)
    task.set_target(target)
    limits = [mink.ConfigurationLimit(model)]
    configuration.update(present.astype(float))
    for _ in range(MINK_STEPS):
        velocity = mink.solve_ik(configuration, [task], 1.0, "daqp", damping=1e-6, limits=limits)
        configuration.integrate_inplace(velocity, 1.0)
        error = task.compute_error(configuration)
        if np.linalg.norm(error[:3]) < config.position_tolerance and (
            np.linalg.norm(error[3:]) < config.rotation_tolerance
        ):
            return True
    return False


def problems(scene: Scene, arm: Arm, checker: Checker, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Returns starts and goals f32[count, nq]; the straight path of the second half is blocked, of the first free."""
    address, config = np.asarray(arm.chain.address), PlanningConfig()
    joints = random_joints(arm, 5, 16 * count)
    joints = joints[[checker.is_free(q[address]) for q in joints]]
    half = len(joints) // 2
    start, goal = joints[:half], joints[half : 2 * half]
    is_free = np.asarray(jax.jit(jax.vmap(lambda a, b: edge_is_free(arm, a, b, config)))(start, goal))
    touches = np.array(
        [not checker.is_path_free(np.stack(ends)[:, address], SPACING) for ends in zip(start, goal, strict=True)]
    )
    chosen = np.concatenate([np.flatnonzero(is_free)[: count // 2], np.flatnonzero(touches)[: count - count // 2]])
    return start[chosen], goal[chosen]


def solve_ompl(arm: Arm, checker: Checker, start: np.ndarray, goal: np.ndarray) -> tuple[np.ndarray | None, float]:
    """Returns OMPL's simplified path f64[W, J], and the seconds that it took before it was simplified."""
    address = np.asarray(arm.chain.address)
    count = len(address)
    space = base.RealVectorStateSpace(count)
    bounds = base.RealVectorBounds(count)
    for i, a in enumerate(address):
        bounds.setLow(i, float(arm.lower[a]))
        bounds.setHigh(i, float(arm.upper[a]))
    space.setBounds(bounds)
    setup = geometric.SimpleSetup(space)
    setup.setStateValidityChecker(lambda state: checker.is_free(np.array([state[i] for i in range(count)])))
    information = setup.getSpaceInformation()
    information.setStateValidityCheckingResolution(SPACING / space.getMaximumExtent())
    setup.setPlanner(geometric.RRTConnect(information))
    ends = [space.allocState(), space.allocState()]
    for state, qpos in zip(ends, (start, goal), strict=True):
        for i, a in enumerate(address):
            state[i] = float(qpos[a])
    setup.setStartAndGoalStates(*ends)
    began = time.perf_counter()
    setup.solve(OMPL_SECONDS)
    seconds = time.perf_counter() - began
    if not setup.haveExactSolutionPath():
        return None, seconds
    setup.simplifySolution()
    path = setup.getSolutionPath()
    states = [path.getState(i) for i in range(path.getStateCount())]
    return np.array([[state[i] for i in range(count)] for state in states]), seconds


def benchmark_rrt(num_problems: int) -> None:
    """Prints success, path lengths and rates of both, for the whole and for the half that needs a detour."""
    scene = build_scene(SceneConfig(obstacles="posts"))
    arm, config = build_arm(scene), PlanningConfig()
    checker = Checker(scene, np.asarray(arm.home))
    start, goal = problems(scene, arm, checker, num_problems)
    num_problems, address = len(start), np.asarray(arm.chain.address)
    plan = jax.jit(jax.vmap(lambda key, a, b: rrt_connect(arm, key, a, b, config)))
    keys = jax.random.split(jax.random.key(0), num_problems)
    theirs, seconds, whole = [], [], []
    for a, b in zip(start, goal, strict=True):
        began = time.perf_counter()
        path, spent = solve_ompl(arm, checker, a, b)
        theirs.append(path)
        seconds.append(spent)
        whole.append(time.perf_counter() - began)
    for name, part in (("all", slice(None)), ("detours", slice(num_problems // 2, None))):
        paths, own = timed(lambda part=part: plan(keys[part], start[part], goal[part]))
        ours = [np.asarray(path)[:, address] for path in paths.waypoints]
        found = np.asarray(paths.status) == 0
        other = np.array([path is not None for path in theirs[part]])
        both = np.flatnonzero(found & other)
        ratios = [length(ours[i]) / length(theirs[part][i]) for i in both]
        free = np.mean([checker.is_path_free(ours[i], SPACING / 4) for i in np.flatnonzero(found)])
        other_free = np.mean([checker.is_path_free(p, SPACING / 4) for p in theirs[part] if p is not None])
        count, raw, simplified = len(ours), sum(seconds[part]), sum(whole[part])
        print(
            f"{name}, {count}: found {found.mean():.3f}, OMPL {other.mean():.3f}; free on a dense check {free:.3f}, "
            f"OMPL {other_free:.3f}; median length / OMPL's {np.median(ratios):.3f}; ours {count / own:,.0f}/s, OMPL "
            f"{count / raw:,.1f}/s ({count / simplified:,.1f}/s with simplification); ratio {raw / own:.1f} "
            f"({simplified / own:.1f})",
            flush=True,
        )


def main() -> None:
    """Runs both comparisons."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--poses", type=int, default=2000)
    parser.add_argument("--problems", type=int, default=200)
    parser.add_argument("--skip-ik", action="store_true")
    arguments = parser.parse_args()
    util.noOutputHandler()
    if not arguments.skip_ik:
        benchmark_ik(arguments.poses)
    benchmark_rrt(arguments.problems)


if __name__ == "__main__":
    main()
