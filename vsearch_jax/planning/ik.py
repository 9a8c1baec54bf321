"""Inverse kinematics by Levenberg-Marquardt inside the joint limits, from several starts at once."""

from __future__ import annotations

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jaxlie import SE3, SO3

from vsearch_jax.arm import Arm, camera_kinematics, forward_kinematics, is_free
from vsearch_jax.config import IKConfig
from vsearch_jax.geometry import rotation_error
from vsearch_jax.types import IKResult

# Metres that one radian weighs in the cost: about the lever of a wrist.
ROTATION_WEIGHT = 0.3
# Longest step of a joint, in rad or m: the linear model holds no farther.
MAX_STEP = 0.8
DAMPING_FALL, DAMPING_RISE = 0.2, 5.0
DAMPING_RANGE = (1e-7, 1e2)


class _Iterate(NamedTuple):
    """Joints f32[J] with cost f32[], weighted error f32[6], weighted Jacobian f32[6, J] and damping f32[]."""

    joints: Array
    cost: Array
    error: Array
    jacobian: Array
    damping: Array


def ik(arm: Arm, T_world_camera: SE3, qpos: Array, config: IKConfig) -> IKResult:
    """Returns joints that bring the wrist camera to `T_world_camera`.

    Starts are the present joints and `config.num_seeds - 1` others, spread evenly over the limits. Of the solutions the
    nearest to the present joints is returned, one without contact before one with; without any, the closest try.
    Joints that do not move the camera (fingers) stay.

    Args:
      arm: the arm.
      T_world_camera: the pose wanted, in world.
      qpos: f32[nq] rad or m, the present joints. Values that are not finite count as the middle of the limits.
      config: iterations, damping, tolerances and number of starts.
    """
    spread = spread_starts(arm, config.num_seeds - 1)
    starts = jnp.concatenate([qpos[None], spread])
    return ik_from_starts(arm, T_world_camera, starts, qpos, config)[0]


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
    travel = jnp.linalg.norm(results.qpos[:, address] - _finite(arm, qpos)[address][None], axis=-1)
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
    solve = jax.vmap(_solve, in_axes=(None, None, 0, None, None))
    results = solve(arm, T_world_camera, starts, qpos, config)
    is_clear = jax.vmap(lambda q: is_free(arm, forward_kinematics(arm, q)))(results.qpos)
    return results, results.is_converged & is_clear


def rank(results: IKResult, is_valid: Array, preference: Array) -> Array:
    """Returns f32[K], least for the best: valid before converged before the rest, then by preference or by error.

    Args:
      results: IKResult, leading axis K.
      is_valid: bool[K].
      preference: f32[K], less is better; below 1e3.
    """
    error = jnp.minimum(results.position_error + ROTATION_WEIGHT * results.rotation_error, 1e3)
    error = jnp.where(jnp.isfinite(error), error, 1e3)
    order = jnp.where(is_valid, preference, 1e4 + preference)
    return jnp.where(results.is_converged, order, 1e5 + error)


def spread_starts(arm: Arm, count: int) -> Array:
    """Returns f32[count, nq] rad or m: a low-discrepancy sequence over the limits, +-pi where there are none.

    Source: Roberts, The unreasonable effectiveness of quasirandom sequences (2018): steps are powers of the root of
    x^(d + 1) = x + 1.
    """
    dimension = arm.home.shape[0]
    root = 2.0
    for _ in range(60):
        root = (1.0 + root) ** (1.0 / (dimension + 1))
    steps = root ** -jnp.arange(1.0, dimension + 1.0)
    fraction = jnp.mod(0.5 + jnp.arange(1.0, count + 1.0)[:, None] * steps[None], 1.0)
    lower, upper = start_limits(arm)
    return lower[None] + fraction * (upper - lower)[None]


def start_limits(arm: Arm) -> tuple[Array, Array]:
    """Returns lower and upper limits f32[nq], +-pi where the joint has none."""
    return (
        jnp.where(jnp.isfinite(arm.lower), arm.lower, -jnp.pi),
        jnp.where(jnp.isfinite(arm.upper), arm.upper, jnp.pi),
    )


def _finite(arm: Arm, qpos: Array) -> Array:
    return jnp.clip(jnp.where(jnp.isfinite(qpos), qpos, arm.home), arm.lower, arm.upper)


def _solve(arm: Arm, target: SE3, start: Array, qpos: Array, config: IKConfig) -> IKResult:
    address = arm.chain.address
    lower, upper = arm.lower[address], arm.upper[address]
    joints = _finite(arm, start)[address]
    position, rotation = target.translation(), target.rotation().as_matrix()

    step = functools.partial(_step, arm, (position, rotation), (lower, upper))
    cost, error, jacobian = _cost(arm, joints, position, rotation)
    state = _Iterate(joints, cost, error, jacobian, jnp.float32(config.damping))
    state = jax.lax.fori_loop(0, config.num_iterations, step, state)
    reached_position, reached_rotation, _ = camera_kinematics(arm, state.joints)
    position_error = jnp.linalg.norm(reached_position - position)
    angle = rotation_error(reached_rotation, rotation)
    return IKResult(
        qpos=_finite(arm, qpos).at[address].set(state.joints),
        position_error=position_error,
        rotation_error=angle,
        is_converged=(position_error < config.position_tolerance)
        & (angle < jnp.deg2rad(config.rotation_tolerance_deg)),
    )


def _step(arm: Arm, target: tuple[Array, Array], limits: tuple[Array, Array], _: int, state: _Iterate) -> _Iterate:
    """One step of Levenberg-Marquardt, kept only if the cost falls; NaN never falls, so the joints stay finite."""
    lower, upper = limits
    descent = state.jacobian.T @ state.error
    is_held = ((state.joints <= lower) & (descent < 0.0)) | ((state.joints >= upper) & (descent > 0.0))
    # A joint at its limit that would go beyond takes no part, so that the others make up for it.
    jacobian = jnp.where(is_held, 0.0, state.jacobian)
    normal = jnp.sum(jacobian[:, None, :] * jacobian[None, :, :], axis=-1) + state.damping * jnp.eye(6)
    factor = jax.scipy.linalg.cho_factor(normal)
    change = jnp.sum(jacobian * jax.scipy.linalg.cho_solve(factor, state.error)[:, None], axis=0)
    change = change * jnp.minimum(1.0, MAX_STEP / jnp.maximum(jnp.max(jnp.abs(change)), 1e-9))
    joints = jnp.clip(state.joints + change, lower, upper)
    cost, error, jacobian = _cost(arm, joints, *target)
    is_better = cost < state.cost
    damping = jnp.clip(state.damping * jnp.where(is_better, DAMPING_FALL, DAMPING_RISE), *DAMPING_RANGE)
    new = _Iterate(joints, cost, error, jacobian, damping)
    return jax.tree.map(lambda a, b: jnp.where(is_better, a, b), new, state._replace(damping=damping))


def _cost(arm: Arm, joints: Array, position: Array, rotation: Array) -> tuple[Array, Array, Array]:
    reached_position, reached_rotation, jacobian = camera_kinematics(arm, joints)
    relative = jnp.sum(rotation[:, None, :] * reached_rotation[None, :, :], axis=-1)
    error = jnp.concatenate([position - reached_position, ROTATION_WEIGHT * SO3.from_matrix(relative).log()])
    weights = jnp.array([1.0, 1.0, 1.0, ROTATION_WEIGHT, ROTATION_WEIGHT, ROTATION_WEIGHT])
    return jnp.sum(error * error), error, jacobian * weights[:, None]
