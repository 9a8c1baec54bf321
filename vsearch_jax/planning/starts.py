"""Inverse kinematics from given starts, all at once: where good ones are at hand, as from the reachability map."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
from jax import Array
from jaxlie import SE3
from mujoco import mjx

from vsearch_jax.config import IKConfig
from vsearch_jax.planning import levenberg
from vsearch_jax.planning.levenberg import Goal, goal_of
from vsearch_jax.robot.arm import Arm, forward_kinematics, is_free
from vsearch_jax.types import IKResult, IKStatus


def ik_from_starts(
    arm: Arm,
    T_world_camera: SE3,
    starts: Array,
    qpos: Array,
    config: IKConfig,
) -> tuple[IKResult, Array]:
    """Solves from every start and returns the valid solution nearest to the present joints.

    Args:
      arm: the arm.
      T_world_camera: the pose wanted, in world.
      starts: f32[K, nq] rad or m.
      qpos: f32[nq] rad or m, the present joints; those that do not move the camera are taken from here.
      config: iterations, damping and tolerances.

    Returns:
      The result, and bool[] whether it is valid: converged, inside the limits and without contact.
    """
    results, is_valid = solve_starts(arm, T_world_camera, starts, qpos, config)
    address = arm.chain.address
    travel = jnp.linalg.norm(results.qpos[:, address] - finite_joints(arm, qpos)[address][None], axis=-1)
    best = jnp.argmin(rank(results, is_valid, travel))
    return jax.tree.map(lambda leaf: leaf[best], results), is_valid[best]


def solve_starts(
    arm: Arm,
    T_world_camera: SE3,
    starts: Array,
    qpos: Array,
    config: IKConfig,
) -> tuple[IKResult, Array]:
    """Returns the result from each of the starts f32[K, nq], leading axis K, and bool[K] which of them are valid."""
    goal, address = goal_of(arm, T_world_camera), arm.chain.address

    def solve(start: Array) -> tuple[IKResult, Array]:
        iterate = levenberg.begin(finite_joints(arm, start)[address], config)
        body = functools.partial(levenberg.step, arm, goal, config=config)
        iterate = jax.lax.fori_loop(0, config.num_iterations + 1, lambda _, iterate: body(iterate), iterate)
        data = forward_kinematics(arm, finite_joints(arm, qpos).at[address].set(iterate.joints))
        return judge(arm, config, goal, data, qpos), is_free(arm, data)

    results, is_clear = jax.vmap(solve)(starts)
    return results, results.is_converged & is_clear


def rank(results: IKResult, is_valid: Array, preference: Array) -> Array:
    """Returns f32[K], least for the best: valid before converged before the rest, then by preference or by error.

    Args:
      results: IKResult, leading axis K.
      is_valid: bool[K].
      preference: f32[K], less is better; below 1e3.
    """
    error = jnp.minimum(results.position_error + levenberg.ROTATION_WEIGHT * results.rotation_error, 1e3)
    error = jnp.where(jnp.isfinite(error), error, 1e3)
    order = jnp.where(is_valid, preference, 1e4 + preference)
    return jnp.where(results.is_converged, order, 1e5 + error)


def start_limits(arm: Arm) -> tuple[Array, Array]:
    """Returns lower and upper limits f32[nq], +-pi where the joint has none."""
    return (
        jnp.where(jnp.isfinite(arm.lower), arm.lower, -jnp.pi),
        jnp.where(jnp.isfinite(arm.upper), arm.upper, jnp.pi),
    )


def finite_joints(arm: Arm, qpos: Array) -> Array:
    """Returns `qpos` (f32[nq]) inside the limits, with the middle of the limits where it is not finite."""
    return jnp.clip(jnp.where(jnp.isfinite(qpos), qpos, arm.home), arm.lower, arm.upper)


def judge(arm: Arm, config: IKConfig, goal: Goal, data: mjx.Data, qpos: Array) -> IKResult:
    """Returns what the joints of `data`, which holds their kinematics, are worth; `qpos` (f32[nq]) were the present."""
    position, rotation = data.cam_xpos[arm.camera_id], data.cam_xmat[arm.camera_id]
    position_error = jnp.linalg.norm(position - goal.position)
    angle = jnp.linalg.norm(levenberg.turn(goal.rotation, rotation, config))
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
