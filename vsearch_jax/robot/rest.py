"""The arm's rest pose. It keeps the equality constraints of grippers: mimic fingers and closed linkages."""

from __future__ import annotations

import copy

import mujoco
import numpy as np

# Largest violation in m or rad of an equality constraint.
TOLERANCE = 1e-4
NUM_ITERATIONS = 100
# Damping of the Gauss-Newton steps, which keeps redundant constraints solvable.
DAMPING = 1e-6


def rest_pose(
    model: mujoco.MjModel, lower: np.ndarray, upper: np.ndarray, camera_joints: tuple[int, ...]
) -> np.ndarray:
    """Returns the joint values at which the arm rests.

    Limited joints rest in the middle of their limits, others at `qpos0`. If that violates an equality constraint, the
    joints of violated constraints that do not move the camera start at `qpos0` instead, where MuJoCo defines the
    constraints, and move until these are satisfied.

    Args:
      model: the compiled scene; its joints are hinges and slides.
      lower: f64[nq] rad or m, lower joint limits; -inf for none.
      upper: f64[nq] rad or m, upper joint limits; +inf for none.
      camera_joints: MuJoCo's numbers of the joints that move the camera.

    Returns:
      f64[nq] rad or m. If the constraints cannot be satisfied inside the limits, the violation is as small as found.
    """
    is_limited, middle = np.isfinite(lower), model.qpos0.copy()
    middle[is_limited] = 0.5 * (lower[is_limited] + upper[is_limited])
    dense = copy.copy(model)
    dense.opt.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
    dense.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    data = mujoco.MjData(dense)
    error, jacobian = _violation(dense, data, middle)
    is_violated = np.abs(error) > TOLERANCE
    is_free = np.any(jacobian[is_violated] != 0.0, axis=0)
    is_free[model.jnt_qposadr[list(camera_joints)]] = False
    if not is_free.any():
        return middle
    # Joints that other constraints tie to these ones must move with them.
    for _ in range(len(error)):
        is_free |= np.any(jacobian[np.any(jacobian[:, is_free] != 0.0, axis=1)] != 0.0, axis=0)
        is_free[model.jnt_qposadr[list(camera_joints)]] = False
    return _settle(dense, data, np.where(is_free, np.clip(model.qpos0, lower, upper), middle), is_free, (lower, upper))


def _settle(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    qpos: np.ndarray,
    is_free: np.ndarray,
    limits: tuple[np.ndarray, np.ndarray],
) -> np.ndarray:
    """Moves the joints `is_free` (bool[nq]) by Gauss-Newton until the equality constraints hold; returns the best."""
    best, smallest = qpos, np.inf
    for _ in range(NUM_ITERATIONS):
        error, jacobian = _violation(model, data, qpos)
        largest = float(np.abs(error).max(initial=0.0))
        if largest < smallest:
            best, smallest = qpos, largest
        if largest <= TOLERANCE:
            break
        columns = jacobian[:, is_free]
        system = columns.T @ columns + DAMPING * np.eye(columns.shape[1])
        qpos = qpos.copy()
        qpos[is_free] -= np.linalg.solve(system, columns.T @ error)
        qpos = np.clip(qpos, *limits)
    return best


def _violation(model: mujoco.MjModel, data: mujoco.MjData, qpos: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns the violations f64[E] m or rad of the E equality constraints, and their Jacobian f64[E, nv]."""
    data.qpos[:] = qpos
    mujoco.mj_fwdPosition(model, data)
    is_equality = data.efc_type == int(mujoco.mjtConstraint.mjCNSTR_EQUALITY)
    return data.efc_pos[is_equality].copy(), data.efc_J.reshape(-1, model.nv)[is_equality].copy()
