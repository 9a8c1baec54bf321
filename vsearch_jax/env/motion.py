"""Motions of the arm between two configurations: straight, along a planned path, or by the arm's dynamics."""

from __future__ import annotations

from collections.abc import Callable

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
from vsearch_jax.xla.tree import tree_where

_PLANNING_SEED = 20_191_202
"""Seed of the random trees. It is fixed, so the path between two configurations is always the same."""


def joints_from_uniform(arm: Arm, numbers: Array) -> Array:
    """Maps random numbers from [0, 1) to random joint values inside the joint limits.

    Args:
      arm: the arm.
      numbers: f32[nq] in [0, 1), one number for each joint value.

    Returns:
      Joint values f32[nq] rad or m. Only the joints that move the camera vary. The other joints have their home values.
    """
    lower, upper = start_limits(arm)
    address = arm.chain.address
    joints = lower + (upper - lower) * numbers
    return arm.home.at[address].set(joints[address])


def straight_motion(arm: Arm, qpos: Array, goal: Array, config: PlanningConfig) -> Motion:
    """Returns the cost of a straight motion between two configurations (joint values). Obstacles are ignored.

    Args:
      arm: the arm.
      qpos: f32[nq] rad or m, joint values at the start.
      goal: f32[nq] rad or m, joint values at the end.
      config: settings of timing; the acceleration time is read.

    Returns:
      Length and duration of the motion; it is always found.
    """
    travel = jnp.linalg.norm((goal - qpos)[arm.chain.address])
    return Motion(jnp.bool_(True), travel, straight_duration(arm, qpos, goal, config))


def plan_motion(arm: Arm, qpos: Array, goal: Array, config: PlanningConfig) -> tuple[Trajectory, Motion]:
    """Plans a path without contact between two configurations (joint values), and times the motion along it.

    Equal arguments give equal motions.

    Args:
      arm: the arm.
      qpos: f32[nq] rad or m, joint values at the start.
      goal: f32[nq] rad or m, joint values at the end.
      config: settings of path planning and timing.

    Returns:
      The timed motion, and its cost. If no path is found, the arm stays at the start, and the cost says so.

    Raises:
      PlanningError: the model gives no speed limit for a joint.
    """
    path = _plan_path(arm, qpos, goal, config)
    trajectory = time_path(arm, path, config)
    return trajectory, Motion(_is_found(path), path.length, duration(trajectory))


def move_joints(
    scene: Scene, arm: Arm, qpos: Array, goals: Callable[[Array], tuple[Array, Array]], config: Config
) -> tuple[Array, Motion]:
    """Plans a path without contact to one of several goals, and moves the arm along it.

    The goals are tried one after another, `planning.num_goals` at most, until a path leads to one. Without a first goal
    no other is tried.

    Args:
      scene: the scene. The MJX model in it is used for dynamic motion.
      arm: the arm.
      qpos: f32[nq] rad or m, joint values at the start.
      goals: returns for the number of a goal, i32[], its joint values f32[nq] rad or m; and bool[], whether there is
        such a goal.
      config: the run's config; `env.motion` chooses kinematic motion or the arm's simulated dynamics.

    Returns:
      Joint values after the motion, f32[nq] rad or m, and the cost of the planned motion. Kinematic motion ends at the
      goal. Dynamic motion follows the path and ends near the goal. If no path is found, the arm stays.
    """
    path = _path_to_first(arm, qpos, goals, config.planning)
    is_kinematic = config.env.motion == "kinematic"
    if arm.joints_without_speed and is_kinematic:
        return path.waypoints[-1], Motion(_is_found(path), path.length, jnp.float32(jnp.nan))
    trajectory = time_path(arm, path, config.planning)
    motion = Motion(_is_found(path), path.length, duration(trajectory))
    if is_kinematic:
        return trajectory.waypoints[-1], motion
    reached = execute(arm, scene.mjx_model, trajectory, config.planning).qpos
    # MuJoCo's joint limits are soft. The next plan can only start inside the limits.
    return jnp.clip(reached, arm.lower, arm.upper), motion


def _path_to_first(
    arm: Arm, qpos: Array, goals: Callable[[Array], tuple[Array, Array]], config: PlanningConfig
) -> Path:
    """Returns a path to the first of the goals to which one is found; see `move_joints`."""

    def attempt(state: tuple[Array, Array, Path]) -> tuple[Array, Array, Path]:
        number, is_open, path = state
        goal, is_goal = goals(number)
        # Where nothing is to be planned, the goal is the start. The planner is then done at once.
        planned = _plan_path(arm, qpos, jnp.where(is_open & is_goal, goal, qpos), config)
        path = tree_where(is_goal, planned, path)
        return number + 1, (is_goal | (number > 0)) & ~_is_found(path), path

    stay = Path(
        waypoints=jnp.broadcast_to(qpos[None], (config.max_waypoints, *qpos.shape)),
        length=jnp.float32(jnp.inf),
        status=jnp.int32(PlanStatus.GOAL_BLOCKED),
    )
    # One loop compiles IK and planner once. It ends as soon as no problem of a batch is open.
    start = (jnp.int32(0), jnp.bool_(True), stay)
    return jax.lax.while_loop(lambda state: state[1] & (state[0] < config.num_goals), attempt, start)[2]


def _plan_path(arm: Arm, qpos: Array, goal: Array, config: PlanningConfig) -> Path:
    return rrt_connect(arm, jax.random.key(_PLANNING_SEED), qpos, goal, config)


def _is_found(path: Path) -> Array:
    return path.status == int(PlanStatus.FOUND)
