"""Levenberg-Marquardt steps towards a camera pose, inside the joint limits.

Here `joints` are the J joints of the chain that moves the wrist camera.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jaxlie import SE3, SO3

from vsearch_jax.config import IKConfig
from vsearch_jax.robot.arm import Arm, camera_kinematics
from vsearch_jax.xla.tree import tree_where

# Weight in m of one radian in the cost. It is about the distance from a wrist joint to the camera.
ROTATION_WEIGHT = 0.3
# Longest step of one joint, in rad or m. The linear model is not valid for longer steps.
MAX_STEP = 0.8
# Factors of the damping after a step that lowers the cost and after one that does not.
DAMPING_DECREASE, DAMPING_INCREASE = 0.2, 5.0
DAMPING_RANGE = (1e-7, 1e2)


class Goal(NamedTuple):
    """An IK problem: the camera pose to reach and the joint limits to stay inside. J joints move the camera.

    Attributes:
      position: f32[3] m in world, wanted position of the camera.
      rotation: f32[3, 3], wanted rotation of the camera, camera to world.
      lower: f32[J] rad or m, lower joint limits.
      upper: f32[J] rad or m, upper joint limits.
    """

    position: Array
    rotation: Array
    lower: Array
    upper: Array


class Iterate(NamedTuple):
    """State of the iteration of one IK problem: the best joints so far and the joints to try next.

    J joints move the camera.

    Attributes:
      trial: f32[J] rad or m, joints to try next.
      joints: f32[J] rad or m, best joints so far.
      cost: f32[], squared length of `error`; +inf before the first step.
      error: f32[6] at `joints`, in the frame of the goal's camera: m, then rad times `ROTATION_WEIGHT`.
      jacobian: f32[6, J] of the camera pose at `joints`, in the units and the frame of `error`.
      damping: f32[], damping of the normal equations.
    """

    trial: Array
    joints: Array
    cost: Array
    error: Array
    jacobian: Array
    damping: Array


def goal_from_pose(arm: Arm, T_world_camera: SE3) -> Goal:
    """Returns the IK problem: the camera pose to reach and the joint limits to stay inside.

    Args:
      arm: the arm. Its joint limits are used.
      T_world_camera: wanted pose of the wrist camera in world.
    """
    address = arm.chain.address
    rotation = T_world_camera.rotation().as_matrix()
    return Goal(T_world_camera.translation(), rotation, arm.lower[address], arm.upper[address])


def start_iterate(start: Array, config: IKConfig) -> Iterate:
    """Returns the initial state of the Levenberg-Marquardt iteration. Its first trial is `start`.

    Args:
      start: f32[J] rad or m, values of the J joints that move the camera.
      config: `damping` is the initial damping.
    """
    count = start.shape[0]
    return Iterate(
        start,
        start,
        jnp.float32(jnp.inf),
        jnp.zeros(6),
        jnp.zeros((6, count)),
        jnp.float32(config.damping),
    )


def evaluate_trial(arm: Arm, goal: Goal, iterate: Iterate, config: IKConfig) -> Iterate:
    """Computes the pose error, the cost and the Jacobian at the joints that are to be tried (`iterate.trial`).

    Args:
      arm: the arm.
      goal: wanted camera pose.
      iterate: state of the iteration; its `trial` is evaluated.
      config: whether the camera may roll.

    Returns:
      The state with the trial as its best `joints`, even if the cost is higher.
    """
    position, rotation, jacobian = camera_kinematics(arm, iterate.trial)
    position_error = _to_frame(goal.rotation, goal.position - position)
    rotation_error = rotation_error_vector(goal.rotation, rotation, config)
    error = jnp.concatenate([position_error, ROTATION_WEIGHT * rotation_error])
    linear, angular = (_to_frame(goal.rotation, rows.T).T for rows in (jacobian[:3], jacobian[3:]))
    weights = jnp.full(3, ROTATION_WEIGHT).at[2].multiply(0.0 if config.is_roll_free else 1.0)
    jacobian = jnp.concatenate([linear, angular * weights[:, None]])
    return iterate._replace(joints=iterate.trial, cost=jnp.sum(error * error), error=error, jacobian=jacobian)


def rotation_error_vector(wanted: Array, reached: Array, config: IKConfig) -> Array:
    """Returns the rotation that the camera still has to make, as a rotation vector f32[3] rad.

    The vector is in the frame of the wanted camera. If the camera may roll, the rotation is the shortest one that
    aligns the optical axis. Its component about that axis is 0.

    Args:
      wanted: f32[3, 3], wanted rotation of the camera, camera to world.
      reached: f32[3, 3], present rotation of the camera, camera to world.
      config: whether the camera may roll.
    """
    relative = jnp.sum(wanted[:, :, None] * reached[:, None, :], axis=0)
    if not config.is_roll_free:
        return -SO3.from_matrix(relative).log()
    axis = relative[:, 2]
    sine = jnp.sqrt(jnp.maximum(axis[0] ** 2 + axis[1] ** 2, 1e-20))
    angle = jnp.arctan2(sine, axis[2])
    return jnp.stack([axis[1], -axis[0], jnp.zeros(())]) * (angle / sine)


def advance_iterate(arm: Arm, goal: Goal, iterate: Iterate, config: IKConfig) -> Iterate:
    """Does one Levenberg-Marquardt step: evaluates the trial, keeps it if its cost is lower, proposes the next trial.

    A NaN cost is never lower, so `joints` stay finite.

    Args:
      arm: the arm.
      goal: wanted camera pose, and the joint limits.
      iterate: state of the iteration.
      config: whether the camera may roll.

    Returns:
      The next state of the iteration.
    """
    new = evaluate_trial(arm, goal, iterate, config)
    is_better = new.cost < iterate.cost
    kept = tree_where(is_better, new, iterate)
    factor = jnp.where(is_better, DAMPING_DECREASE, DAMPING_INCREASE)
    damping = jnp.where(jnp.isinf(iterate.cost), kept.damping, jnp.clip(kept.damping * factor, *DAMPING_RANGE))
    kept = kept._replace(damping=damping)
    change = compute_step(goal, kept, jnp.zeros_like(kept.joints))
    return kept._replace(trial=apply_step(goal, kept.joints, change, MAX_STEP))


def compute_step(goal: Goal, iterate: Iterate, preferred: Array) -> Array:
    """Returns the change of the joints, f32[J] rad or m, that reduces the error of the camera pose.

    It is the damped least-squares step with a secondary objective in the nullspace. K is the Jacobian. With
    A = K K^T + damping * I, the step is preferred + K^T A^-1 (error - K preferred) (Siciliano et al., Robotics, 3.5.1).
    A joint at its limit that would move outward is held, and the other joints compensate for it.

    Args:
      goal: the joint limits.
      iterate: joints, error, Jacobian and damping.
      preferred: f32[J] rad or m, wanted change of the J joints that move the camera. It is followed only as far as it
        does not change the error.
    """
    joints, jacobian = iterate.joints, iterate.jacobian
    descent = jnp.sum(jacobian * iterate.error[:, None], axis=0) + preferred
    is_held = ((joints <= goal.lower) & (descent < 0.0)) | ((joints >= goal.upper) & (descent > 0.0))
    jacobian = jnp.where(is_held[None], 0.0, jacobian)
    preferred = jnp.where(is_held, 0.0, preferred)
    missing = iterate.error - jnp.sum(jacobian * preferred[None], axis=-1)
    normal = jnp.sum(jacobian[:, None, :] * jacobian[None, :, :], axis=-1) + iterate.damping * jnp.eye(6)
    return preferred + jnp.sum(jacobian * _solve_linear(normal, missing)[:, None], axis=0)


def apply_step(goal: Goal, joints: Array, change: Array, max_step: float) -> Array:
    """Moves the joints by `change`, but no joint by more than `max_step`, and clips the result to the joint limits.

    Args:
      goal: the joint limits.
      joints: f32[J] rad or m, values of the J joints that move the camera.
      change: f32[J] rad or m, wanted change. All its components are scaled by the same factor to keep `max_step`.
      max_step: rad or m, maximum change of a joint.

    Returns:
      New joint values, f32[J] rad or m.
    """
    change = change * jnp.minimum(1.0, max_step / jnp.maximum(jnp.max(jnp.abs(change)), 1e-9))
    return jnp.clip(joints + change, goal.lower, goal.upper)


def _solve_linear(matrix: Array, right: Array) -> Array:
    """Solves `matrix` x = `right` by Gauss-Jordan elimination; f32[6, 6] positive definite, f32[6].

    A positive definite matrix needs no pivots. In a batch this is twice as fast as LAPACK.
    """
    return jax.lax.fori_loop(0, 6, _eliminate, jnp.concatenate([matrix, right[:, None]], axis=1))[:, 6]


def _eliminate(index: Array, system: Array) -> Array:
    """Eliminates column `index` from the system f32[6, 7]."""
    row = system[index] / system[index, index]
    return (system - system[:, index][:, None] * row[None]).at[index].set(row)


def _to_frame(rotation: Array, vectors: Array) -> Array:
    """Returns `vectors` (f32[..., 3], world) in the frame whose axes in world are the columns of `rotation`."""
    rotation = rotation.reshape((1,) * (vectors.ndim - 1) + rotation.shape)
    return jnp.sum(vectors[..., :, None] * rotation, axis=-2)
