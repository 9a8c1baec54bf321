"""Which actuators drive the arm, and the controls with which they follow a motion.

An actuator acts on a length: gear times the joint's value, or the length of a tendon or of another transmission. Its
force is gain * control + b0 + b1 * length + b2 * velocity (MuJoCo's manual, Actuation model). The control at which this
force is zero on the planned motion makes a position actuator follow the motion without lag. It makes a velocity
actuator demand the planned velocity, and a motor exert no force.
"""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array
from mujoco import mjx

from vsearch_jax.planning.trajectory import check_speeds
from vsearch_jax.robot.arm import Arm
from vsearch_jax.scene import Scene, SceneError

_JOINT = (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT))
_TENDON = int(mujoco.mjtTrn.mjTRN_TENDON)
_NO_BIAS, _AFFINE = int(mujoco.mjtBias.mjBIAS_NONE), int(mujoco.mjtBias.mjBIAS_AFFINE)
_FIXED_GAIN = int(mujoco.mjtGain.mjGAIN_FIXED)
_NO_DYNAMICS, _INTEGRATOR = int(mujoco.mjtDyn.mjDYN_NONE), int(mujoco.mjtDyn.mjDYN_INTEGRATOR)
_FILTERS = (int(mujoco.mjtDyn.mjDYN_FILTER), int(mujoco.mjtDyn.mjDYN_FILTEREXACT))
# A force in N or N m for each unit of an actuator's force. Below it, an actuator does not act on a joint.
_NO_MOMENT = 1e-9


def check_drive(scene: Scene, arm: Arm) -> None:
    """Checks that each joint that moves the camera can be simulated: it has a position actuator and a speed limit.

    Args:
      scene: the scene.
      arm: the arm of the scene, from `build_arm`.

    Raises:
      SceneError: a joint has no position actuator, or an actuator that acts on it cannot follow a motion.
      PlanningError: a joint has no speed limit.
    """
    check_speeds(arm)
    model = scene.mj_model
    acting = _actuators_of_joints(model, scene.joint_ids)
    for actuator in acting:
        fault = _fault(model, actuator)
        if fault:
            raise SceneError(
                f"actuator {model.actuator(actuator).name!r} (number {actuator}) acts on a joint that moves the "
                f"camera, but it {fault}; replace it by <position joint=... kp=... kv=.../>, or set EnvConfig.motion "
                "to 'kinematic'"
            )
    gain = model.actuator_gainprm[:, 0]
    is_position = (gain > 0.0) & np.isclose(model.actuator_biasprm[:, 1], -gain) & (model.actuator_biastype == _AFFINE)
    driven = {int(model.actuator_trnid[a, 0]) for a in acting if is_position[a] and model.actuator_gear[a, 0] != 0.0}
    missing = ", ".join(model.joint(joint).name for joint in scene.joint_ids if joint not in driven)
    if missing:
        raise SceneError(
            f"joint {missing} has no position actuator, but EnvConfig.motion 'dynamic' needs one; add "
            "<position joint=... kp=... kv=.../> to the arm's file, or set EnvConfig.motion to 'kinematic'"
        )


def _actuators_of_joints(model: mujoco.MjModel, joints: tuple[int, ...]) -> list[int]:
    """Returns the actuators that exert a force on one of `joints` through their transmission, at `qpos0`."""
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    moments = np.zeros((model.nu, model.nv))
    if model.nu:
        mujoco.mju_sparse2dense(
            moments, data.actuator_moment, data.moment_rownnz, data.moment_rowadr, data.moment_colind
        )
    acts = np.abs(moments[:, model.jnt_dofadr[list(joints)]]).max(axis=1, initial=0.0) > _NO_MOMENT
    is_on_joint = np.isin(model.actuator_trntype, _JOINT) & np.isin(model.actuator_trnid[:, 0], joints)
    return np.flatnonzero(acts | is_on_joint).tolist()


def _fault(model: mujoco.MjModel, actuator: int) -> str | None:
    """Returns why an actuator cannot follow a motion of the joints that it acts on; None if it can."""
    is_linear = model.actuator_gaintype[actuator] == _FIXED_GAIN and model.actuator_biastype[actuator] in (
        _NO_BIAS,
        _AFFINE,
    )
    if not is_linear:
        return "has a gain or a bias that is not linear"
    if model.actuator_dyntype[actuator] != _NO_DYNAMICS:
        return "has an activation (dyntype or timeconst), so it follows with a delay"
    if model.actuator_trntype[actuator] not in _JOINT and model.actuator_biastype[actuator] != _NO_BIAS:
        return f"pulls through a {'tendon' if model.actuator_trntype[actuator] == _TENDON else 'site or a body'}"
    return None


def start_data(arm: Arm, model: mjx.Model, qpos: Array) -> tuple[mjx.Data, Array]:
    """Prepares the simulation: joints at rest, and all actuators that do not drive a joint hold their lengths.

    Args:
      arm: the arm.
      model: `Scene.mjx_model`.
      qpos: f32[nq] rad or m, joint values at the start.

    Returns:
      The data at the start, activations included. Lengths f32[nu] of the actuators at the start, in the unit of each
      transmission.
    """
    data = dataclasses.replace(arm.data, qpos=qpos)
    if not np.isin(model.actuator_trntype, _JOINT).all():
        # MJX relies on implicit promotion, which the tests forbid.
        with jax.numpy_rank_promotion("allow"), jax.numpy_dtype_promotion("standard"):
            placed = mjx.tendon(model, mjx.com_pos(model, mjx.kinematics(model, data)))
            lengths = mjx.transmission(model, placed).actuator_length
    else:
        lengths = jnp.zeros(model.nu)
    if model.na == 0:
        return data, lengths
    controls = _force_free_controls(model, *_joint_lengths(model, qpos, jnp.zeros(model.nv), lengths))
    is_held = np.isin(model.actuator_dyntype, (_INTEGRATOR, *_FILTERS))
    stateful = np.flatnonzero(model.actuator_actadr >= 0)
    values = jnp.where(is_held[stateful], controls[stateful], 0.0)
    last = model.actuator_actadr[stateful] + model.actuator_actnum[stateful] - 1
    return dataclasses.replace(data, act=data.act.at[last].set(values)), lengths


def actuator_controls(model: mjx.Model, qpos: Array, velocity: Array, held: Array) -> Array:
    """Computes the controls with which the actuators follow a motion.

    Args:
      model: `Scene.mjx_model`.
      qpos: f32[nq] rad or m, planned joint values.
      velocity: f32[nv] rad/s or m/s, planned velocities.
      held: f32[nu], lengths that actuators of tendons and sites hold, from `start_data`.

    Returns:
      Controls f32[nu]. 0 for an actuator whose force is not linear in its length, and for an integrator, which keeps
      its activation.
    """
    controls = _force_free_controls(model, *_joint_lengths(model, qpos, velocity, held))
    return jnp.where(jnp.asarray(model.actuator_dyntype == _INTEGRATOR), 0.0, controls)


def _joint_lengths(model: mjx.Model, qpos: Array, velocity: Array, held: Array) -> tuple[Array, Array]:
    """Returns the lengths and velocities f32[nu] of all actuators; only those of joints move."""
    is_joint = np.isin(model.actuator_trntype, _JOINT)
    joint = np.where(is_joint, model.actuator_trnid[:, 0], 0)
    gear, moves = model.actuator_gear[:, 0], jnp.asarray(is_joint)
    planned: Array = gear * qpos[np.asarray(model.jnt_qposadr)[joint]]
    speed: Array = gear * velocity[np.asarray(model.jnt_dofadr)[joint]]
    return jnp.where(moves, planned, held), jnp.where(moves, speed, 0.0)


def _force_free_controls(model: mjx.Model, length: Array, velocity: Array) -> Array:
    """Returns f32[nu], the controls at which linear actuators exert no force; 0 for others."""
    gain, bias = model.actuator_gainprm[:, 0], model.actuator_biasprm
    is_affine = (model.actuator_biastype == _AFFINE) & (model.actuator_gaintype == _FIXED_GAIN)
    force = bias[:, 0] + bias[:, 1] * length + bias[:, 2] * velocity
    is_linear = jnp.asarray(is_affine) & (jnp.abs(gain) > 0.0)
    controls: Array = -force / jnp.where(is_linear, gain, 1.0)
    return jnp.where(is_linear, controls, 0.0)
