"""One step of Levenberg-Marquardt towards a camera pose, inside the joint limits."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jaxlie import SE3, SO3

from vsearch_jax.config import IKConfig
from vsearch_jax.robot.arm import Arm, camera_kinematics
from vsearch_jax.xla.tree import tree_where

# Metres that one radian weighs in the cost: about the lever of a wrist.
ROTATION_WEIGHT = 0.3
# Longest step of a joint, in rad or m: the linear model holds no farther.
MAX_STEP = 0.8
DAMPING_FALL, DAMPING_RISE = 0.2, 5.0
DAMPING_RANGE = (1e-7, 1e2)


class Goal(NamedTuple):
    """What is solved for: position f32[3] m and rotation f32[3, 3] of the camera in world, and the limits f32[J]."""

    position: Array
    rotation: Array
    lower: Array
    upper: Array


class Iterate(NamedTuple):
    """The best joints so far and those to be tried next.

    Attributes:
      trial: f32[J] rad or m.
      joints: f32[J] rad or m.
      cost: f32[], squared length of `error`; +inf before the first step.
      error: f32[6] in the frame of the camera wanted: m, then rad weighted to m.
      jacobian: f32[6, J] of the camera's pose, in the units and the frame of `error`.
      damping: f32[].
    """

    trial: Array
    joints: Array
    cost: Array
    error: Array
    jacobian: Array
    damping: Array


def goal_of(arm: Arm, T_world_camera: SE3) -> Goal:
    """Returns the goal that `T_world_camera` states."""
    address = arm.chain.address
    rotation = T_world_camera.rotation().as_matrix()
    return Goal(T_world_camera.translation(), rotation, arm.lower[address], arm.upper[address])


def begin(start: Array, config: IKConfig) -> Iterate:
    """Returns the iterate that tries `start` (f32[J]) first."""
    count = start.shape[0]
    return Iterate(
        start,
        start,
        jnp.float32(jnp.inf),
        jnp.zeros(6),
        jnp.zeros((6, count)),
        jnp.float32(config.damping),
    )


def look(arm: Arm, goal: Goal, iterate: Iterate, config: IKConfig) -> Iterate:
    """Returns `iterate` with the trial in place of its joints."""
    position, rotation, jacobian = camera_kinematics(arm, iterate.trial)
    error = jnp.concatenate(
        [_into(goal.rotation, goal.position - position), ROTATION_WEIGHT * turn(goal.rotation, rotation, config)]
    )
    linear, angular = (_into(goal.rotation, rows.T).T for rows in (jacobian[:3], jacobian[3:]))
    weights = jnp.full(3, ROTATION_WEIGHT).at[2].multiply(0.0 if config.is_roll_free else 1.0)
    jacobian = jnp.concatenate([linear, angular * weights[:, None]])
    return iterate._replace(joints=iterate.trial, cost=jnp.sum(error * error), error=error, jacobian=jacobian)


def turn(wanted: Array, reached: Array, config: IKConfig) -> Array:
    """Returns the turn f32[3] rad that is missing, about the axes of the camera wanted.

    With a free roll it takes the optical axis home on the shortest way and has no part about it.

    Args:
      wanted: f32[3, 3], camera to world.
      reached: f32[3, 3], camera to world.
      config: whether the roll is free.
    """
    relative = jnp.sum(wanted[:, :, None] * reached[:, None, :], axis=0)
    if not config.is_roll_free:
        return -SO3.from_matrix(relative).log()
    axis = relative[:, 2]
    sine = jnp.sqrt(jnp.maximum(axis[0] ** 2 + axis[1] ** 2, 1e-20))
    angle = jnp.arctan2(sine, axis[2])
    return jnp.stack([axis[1], -axis[0], jnp.zeros(())]) * (angle / sine)


def step(arm: Arm, goal: Goal, iterate: Iterate, config: IKConfig) -> Iterate:
    """Keeps the trial if its cost is less, and proposes the next; NaN is never less, so the joints stay finite."""
    new = look(arm, goal, iterate, config)
    is_better = new.cost < iterate.cost
    kept = tree_where(is_better, new, iterate)
    rise = jnp.where(is_better, DAMPING_FALL, DAMPING_RISE)
    damping = jnp.where(jnp.isinf(iterate.cost), kept.damping, jnp.clip(kept.damping * rise, *DAMPING_RANGE))
    kept = kept._replace(damping=damping)
    change = update(goal, kept, jnp.zeros_like(kept.joints))
    return kept._replace(trial=moved(goal, kept.joints, change, MAX_STEP))


def update(goal: Goal, iterate: Iterate, preferred: Array) -> Array:
    """Returns the change f32[J] that lessens the error, and follows `preferred` (f32[J]) where the error is free of it.

    With A = J J^T + damping it is preferred + J^T A^-1 (error - J preferred) (Siciliano et al., Robotics, 3.5.1).
    """
    joints, jacobian = iterate.joints, iterate.jacobian
    descent = jnp.sum(jacobian * iterate.error[:, None], axis=0) + preferred
    is_held = ((joints <= goal.lower) & (descent < 0.0)) | ((joints >= goal.upper) & (descent > 0.0))
    # A joint at its limit that would go beyond takes no part, so that the others make up for it.
    jacobian = jnp.where(is_held[None], 0.0, jacobian)
    preferred = jnp.where(is_held, 0.0, preferred)
    missing = iterate.error - jnp.sum(jacobian * preferred[None], axis=-1)
    normal = jnp.sum(jacobian[:, None, :] * jacobian[None, :, :], axis=-1) + iterate.damping * jnp.eye(6)
    return preferred + jnp.sum(jacobian * _solve(normal, missing)[:, None], axis=0)


def moved(goal: Goal, joints: Array, change: Array, max_step: float) -> Array:
    """Returns `joints` (f32[J]) after `change` (f32[J]), shortened to `max_step` a joint and kept inside the limits."""
    change = change * jnp.minimum(1.0, max_step / jnp.maximum(jnp.max(jnp.abs(change)), 1e-9))
    return jnp.clip(joints + change, goal.lower, goal.upper)


def _solve(matrix: Array, right: Array) -> Array:
    """Gauss-Jordan without pivots: `matrix` (f32[6, 6]) is positive definite. Batched, it is twice LAPACK's speed."""
    return jax.lax.fori_loop(0, 6, _eliminate, jnp.concatenate([matrix, right[:, None]], axis=1))[:, 6]


def _eliminate(index: Array, system: Array) -> Array:
    row = system[index] / system[index, index]
    return (system - system[:, index][:, None] * row[None]).at[index].set(row)


def _into(rotation: Array, vectors: Array) -> Array:
    """Returns `vectors` (f32[..., 3], world) in the frame that `rotation` (f32[3, 3]) turns into world."""
    rotation = rotation.reshape((1,) * (vectors.ndim - 1) + rotation.shape)
    return jnp.sum(vectors[..., :, None] * rotation, axis=-2)
