"""Random planning problems among posts, and their solutions by RRT-Connect."""

from __future__ import annotations

import functools

import jax
import numpy as np

from oracles.planning import ContactOracle, free_joints
from vsearch_jax.config import PlanningConfig, SceneConfig
from vsearch_jax.planning import rrt_connect, start_limits
from vsearch_jax.robot.arm import build_arm
from vsearch_jax.scene import build_scene
from vsearch_jax.types import Path, PlanStatus

CONFIG = PlanningConfig()


class PlanningProblems:
    """Random free starts and goals of the LWR among posts.

    Args:
      count: number of problems; those whose goal is not free with the fingers of the start are dropped.
      seed: of the problems and of the planner.
    """

    def __init__(self, count: int, seed: int) -> None:
        self.scene = build_scene(SceneConfig(obstacles="posts"))
        self.arm = build_arm(self.scene)
        self.oracle = ContactOracle(self.scene)
        lower, upper = (np.asarray(limit) for limit in start_limits(self.arm))
        joints = free_joints(self.scene, lower, upper, seed, 2 * count)
        self.start, self.goal = joints[:count], joints[count:]
        self.goal[:, 7:] = self.start[:, 7:]
        is_goal_free = [self.oracle.is_free(q) for q in self.goal]
        self.start, self.goal = self.start[is_goal_free], self.goal[is_goal_free]
        self.keys = jax.random.split(jax.random.key(seed), len(self.start))
        self.plan = jax.jit(jax.vmap(lambda key, a, b: rrt_connect(self.arm, key, a, b, CONFIG)))

    @functools.cached_property
    def paths(self) -> Path:
        """Paths of RRT-Connect, leading axis of the problems."""
        return self.plan(self.keys, self.start, self.goal)

    @functools.cached_property
    def found(self) -> np.ndarray:
        """bool of each problem: a path was found."""
        return np.asarray(self.paths.status) == PlanStatus.FOUND
