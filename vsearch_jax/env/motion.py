"""Motions of the arm between two configurations: straight, along a planned path, or by the arm's dynamics."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import Array

from vsearch_jax.config import Config, PlanningConfig
from vsearch_jax.planning import (
    Motion,
    Trajectory,
    duration,
    rrt_connect,
    start_limits,
    straight_duration,
    time_path,
)
from vsearch_jax.planning.execution import execute
from vsearch_jax.robot.arm import Arm
from vsearch_jax.scene import Scene
from vsearch_jax.types import Path, PlanStatus

_PLANNING_SEED = 20_191_202
"""Seed of the random trees. It is fixed, so the path between two configurations is always the same."""


def joints_from_uniform(arm: Arm, numbers: Array) -> Array:
    """Maps uniform numbers to joint values inside the limits.

    Args:
      arm: the arm.
      numbers: f32[nq] in [0, 1).

    Returns:
      f32[nq] rad or m. Only the joints that move the camera vary; the other joints are at home.
    """
    lower, upper = start_limits(arm)
    address = arm.chain.address
    joints = lower + (upper - lower) * numbers
    return arm.home.at[address].set(joints[address])


def straight_motion(arm: Arm, qpos: Array, goal: Array, config: PlanningConfig) -> Motion:
    """Returns the straight motion between two configurations. Obstacles are ignored.

    Args:
      arm: the arm.
      qpos: f32[nq] rad or m, start.
      goal: f32[nq] rad or m.
      config: acceleration time.
    """
    travel = jnp.linalg.norm((goal - qpos)[arm.chain.address])
    return Motion(jnp.bool_(True), travel, straight_duration(arm, qpos, goal, config))


def plan_motion(arm: Arm, qpos: Array, goal: Array, config: PlanningConfig) -> tuple[Trajectory, Motion]:
    """Plans a timed motion between two configurations. Equal arguments give equal motions.

    Args:
      arm: the arm.
      qpos: f32[nq] rad or m, start.
      goal: f32[nq] rad or m.
      config: settings of path planning and timing.

    Returns:
      The Trajectory and its Motion (costs). If no path is found, the Trajectory stays at the start.

    Raises:
      PlanningError: the model gives no speed limit for a joint.
    """
    path = _plan_path(arm, qpos, goal, config)
    trajectory = time_path(arm, path, config)
    return trajectory, Motion(_is_found(path), path.length, duration(trajectory))


def move_joints(scene: Scene, arm: Arm, qpos: Array, goal: Array, config: Config) -> tuple[Array, Motion]:
    """Plans a motion and moves the arm along it, as `config.env.motion` says.

    Args:
      scene: the Scene; its MJX model is used for dynamic motion.
      arm: the arm.
      qpos: f32[nq] rad or m, start.
      goal: f32[nq] rad or m.
      config: the run's config.

    Returns:
      f32[nq] rad or m, configuration at the end, and the planned Motion. If no path is found, the arm stays.
      Kinematic motion ends at the goal. Dynamic motion follows the path and ends near the goal.
    """
    is_kinematic = config.env.motion == "kinematic"
    if arm.joints_without_speed and is_kinematic:
        path = _plan_path(arm, qpos, goal, config.planning)
        return path.waypoints[-1], Motion(_is_found(path), path.length, jnp.float32(jnp.nan))
    trajectory, motion = plan_motion(arm, qpos, goal, config.planning)
    if is_kinematic:
        return trajectory.waypoints[-1], motion
    reached = execute(arm, scene.mjx_model, trajectory, config.planning).qpos
    # MuJoCo's joint limits are soft. The next plan can only start inside the limits.
    return jnp.clip(reached, arm.lower, arm.upper), motion


def _plan_path(arm: Arm, qpos: Array, goal: Array, config: PlanningConfig) -> Path:
    return rrt_connect(arm, jax.random.key(_PLANNING_SEED), qpos, goal, config)


def _is_found(path: Path) -> Array:
    return path.status == int(PlanStatus.FOUND)
