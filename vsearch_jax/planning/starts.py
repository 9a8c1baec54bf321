"""Inverse kinematics from given starts, all at once.

This needs good starts, for example from the reachability map. `ik` needs none.
"""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
from jax import Array
from jaxlie import SE3
from mujoco import mjx

from vsearch_jax.config import IKConfig
from vsearch_jax.planning import levenberg
from vsearch_jax.planning.levenberg import Goal, goal_from_pose
from vsearch_jax.robot.arm import Arm, forward_kinematics, is_free
from vsearch_jax.types import IKResult, IKStatus
from vsearch_jax.xla.trace_once import trace_once


def ik_from_starts(
    arm: Arm,
    T_world_camera: SE3,
    starts: Array,
    qpos: Array,
    config: IKConfig,
) -> tuple[IKResult, Array]:
    """Solves inverse kinematics from K starts and returns the valid solution nearest to the present joints.

    A solution is valid if it converged, inside the joint limits and without contact.

    Args:
      arm: the arm.
      T_world_camera: wanted pose of the wrist camera in world.
      starts: f32[K, nq] rad or m, joint values from which the iteration starts.
      qpos: f32[nq] rad or m, the present joints. Joints that do not move the camera keep these values.
      config: iterations, damping and tolerances.

    Returns:
      The solution, and bool[] whether it is valid. If no solution is valid, it is the nearest converged one. If none
      converged, it is the one with the smallest error.
    """
    results, is_valid = solve_starts(arm, T_world_camera, starts, qpos, config)
    address = arm.chain.address
    travel = jnp.linalg.norm(results.qpos[:, address] - finite_joints(arm, qpos)[address][None], axis=-1)
    best = jnp.argmin(ranking_cost(results, is_valid, travel))
    return jax.tree.map(lambda leaf: leaf[best], results), is_valid[best]


@trace_once("config")
def solve_starts(
    arm: Arm,
    T_world_camera: SE3,
    starts: Array,
    qpos: Array,
    config: IKConfig,
) -> tuple[IKResult, Array]:
    """Solves inverse kinematics from K starts and returns all K solutions.

    Args:
      arm: the arm.
      T_world_camera: wanted pose of the wrist camera in world.
      starts: f32[K, nq] rad or m, joint values from which the iteration starts.
      qpos: f32[nq] rad or m. Joints that do not move the camera keep these values.
      config: iterations, damping and tolerances.

    Returns:
      One IKResult for each start, leading axis K. bool[K], whether each solution is valid: converged, inside the joint
      limits and without contact.
    """
    goal, address = goal_from_pose(arm, T_world_camera), arm.chain.address

    def solve(start: Array) -> tuple[IKResult, Array]:
        iterate = levenberg.start_iterate(finite_joints(arm, start)[address], config)
        advance = functools.partial(levenberg.advance_iterate, arm, goal, config=config)
        iterate = jax.lax.fori_loop(0, config.num_iterations + 1, lambda _, iterate: advance(iterate), iterate)
        data = forward_kinematics(arm, finite_joints(arm, qpos).at[address].set(iterate.joints))
        return build_result(arm, config, goal, data, qpos), is_free(arm, data)

    results, is_clear = jax.vmap(solve)(starts)
    return results, results.is_converged & is_clear


def ranking_cost(results: IKResult, is_valid: Array, preference: Array) -> Array:
    """Ranks K solutions of one IK problem: returns f32[K], a cost that is lowest for the best solution.

    Valid solutions come first, then those that converged but are in contact, then all others. Solutions that converged
    are ordered by `preference`, all others by their error.

    Args:
      results: the K solutions, leading axis K.
      is_valid: bool[K], whether the solution converged and is without contact.
      preference: f32[K], lower is better. Must be below 1e3.
    """
    error = jnp.minimum(results.position_error + levenberg.ROTATION_WEIGHT * results.rotation_error, 1e3)
    error = jnp.where(jnp.isfinite(error), error, 1e3)
    order = jnp.where(is_valid, preference, 1e4 + preference)
    return jnp.where(results.is_converged, order, 1e5 + error)


def start_limits(arm: Arm) -> tuple[Array, Array]:
    """Returns the range of the random starts of IK: lower and upper ends, f32[nq] rad or m each.

    It is the range inside the joint limits, and from -pi to pi for a joint without limits.
    """
    return (
        jnp.where(jnp.isfinite(arm.lower), arm.lower, -jnp.pi),
        jnp.where(jnp.isfinite(arm.upper), arm.upper, jnp.pi),
    )


def finite_joints(arm: Arm, qpos: Array) -> Array:
    """Makes joint values usable for IK: replaces values that are not finite and clips to the joint limits.

    Args:
      arm: the arm. A value that is not finite becomes that of `arm.home`, the middle of the limits.
      qpos: f32[nq] rad or m, values of all joints.

    Returns:
      Joint values f32[nq] rad or m.
    """
    return jnp.clip(jnp.where(jnp.isfinite(qpos), qpos, arm.home), arm.lower, arm.upper)


def build_result(arm: Arm, config: IKConfig, goal: Goal, data: mjx.Data, qpos: Array) -> IKResult:
    """Measures how far a solution of IK misses the wanted camera pose, and sets its status.

    Args:
      arm: the arm.
      config: tolerances, and whether the camera may roll.
      goal: wanted camera pose.
      data: kinematics at the solution, from `forward_kinematics`.
      qpos: f32[nq] rad or m, the present joints that IK was given. If they are not finite, the status says so.

    Returns:
      The solution with its errors. It is converged only if `qpos` and both errors are finite.
    """
    position, rotation = data.cam_xpos[arm.camera_id], data.cam_xmat[arm.camera_id]
    position_error = jnp.linalg.norm(position - goal.position)
    angle = jnp.linalg.norm(levenberg.rotation_error_vector(goal.rotation, rotation, config))
    is_finite = jnp.all(jnp.isfinite(qpos)) & jnp.isfinite(position_error) & jnp.isfinite(angle)
    is_converged = is_finite & (position_error < config.position_tolerance) & (angle < config.rotation_tolerance)
    status = jnp.where(is_converged, int(IKStatus.SOLVED), int(IKStatus.UNREACHABLE))
    return IKResult(
        qpos=data.qpos,
        position_error=position_error,
        rotation_error=angle,
        is_converged=is_converged,
        status=jnp.where(is_finite, status, int(IKStatus.NOT_FINITE)).astype(jnp.int32),
    )
