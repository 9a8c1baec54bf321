"""The peers of `planning.py` in this folder: mink and OMPL, and the check by C MuJoCo that judges all planners."""

from __future__ import annotations

import importlib
import itertools
import time
from typing import NamedTuple

import mink
import mujoco
import numpy as np

from vsearch_jax.config import IKConfig
from vsearch_jax.robot.arm import Arm
from vsearch_jax.scene import Scene

# OMPL has no type stubs that describe its states, so its modules are imported without types.
base, geometric, util = (importlib.import_module(f"ompl.{name}") for name in ("base", "geometric", "util"))

OMPL_SECONDS = 5.0
# Distance in rad of the configurations that OMPL checks. The final check of both planners uses a quarter of it.
SPACING = 0.02
MINK_STEPS = 60


class OmplSolution(NamedTuple):
    """OMPL's answer to one problem.

    Attributes:
      path: simplified path f64[W, J] rad, or None if none was found.
      planning_seconds: time without simplification.
      total_seconds: time with simplification.
    """

    path: np.ndarray | None
    planning_seconds: float
    total_seconds: float


class Checker:
    """Checks with C MuJoCo whether configurations are free.

    Args:
      scene: the scene. The margin of its table is set to the table's clearance.
      qpos: f64[nq] rad or m, values of the joints outside the chain.
    """

    def __init__(self, scene: Scene, qpos: np.ndarray) -> None:
        self.model = scene.mj_model
        self.model.geom_margin[scene.table_geom_id] = scene.table_clearance
        self.data = mujoco.MjData(self.model)
        self.data.qpos[:] = qpos
        self.address = np.asarray(scene.qpos_addresses)

    def is_free(self, joints: np.ndarray) -> bool:
        """Returns whether nothing touches at the chain's joints (f64[J] rad or m)."""
        self.data.qpos[self.address] = joints
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_collision(self.model, self.data)
        return self.data.ncon == 0

    def is_path_free(self, path: np.ndarray, spacing: float) -> bool:
        """Returns whether all samples of a path are free.

        Args:
          path: f64[W, J] rad or m.
          spacing: largest distance of two samples in rad.
        """
        for start, end in itertools.pairwise(path):
            steps = int(np.linalg.norm(end - start) / spacing) + 1
            if not all(self.is_free(start + u * (end - start)) for u in np.linspace(0.0, 1.0, steps + 1)):
                return False
        return True


def solve_mink(scene: Scene, wanted: np.ndarray, present: np.ndarray, config: IKConfig) -> bool:
    """Returns whether mink reaches the tool pose of `wanted` from `present`.

    Args:
      scene: the scene.
      wanted: f32[nq] rad or m, joints that hold the wanted pose.
      present: f32[nq] rad or m, the start.
      config: tolerances.
    """
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


def solve_ompl(arm: Arm, checker: Checker, start: np.ndarray, goal: np.ndarray) -> OmplSolution:
    """Plans with OMPL's RRT-Connect and simplifies the path.

    Args:
      arm: the arm.
      checker: of the arm's scene.
      start: f32[nq] rad or m.
      goal: f32[nq] rad or m.

    Returns:
      Path and times.
    """
    began = time.perf_counter()
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
    began_planning = time.perf_counter()
    setup.solve(OMPL_SECONDS)
    planning_seconds = time.perf_counter() - began_planning
    if not setup.haveExactSolutionPath():
        return OmplSolution(None, planning_seconds, time.perf_counter() - began)
    setup.simplifySolution()
    path = setup.getSolutionPath()
    states = [path.getState(i) for i in range(path.getStateCount())]
    joints = np.array([[state[i] for i in range(count)] for state in states])
    return OmplSolution(joints, planning_seconds, time.perf_counter() - began)


def silence_ompl() -> None:
    """Turns OMPL's log messages off."""
    util.noOutputHandler()
