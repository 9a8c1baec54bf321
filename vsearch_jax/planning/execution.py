"""Simulates a motion with the arm's dynamics: MJX steps, with position actuators that follow a timed path."""

from __future__ import annotations

import dataclasses
import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array
from mujoco import mjx

from vsearch_jax.config import PlanningConfig
from vsearch_jax.planning.trajectory import Trajectory, check_speeds, duration, state_at
from vsearch_jax.robot.arm import Arm
from vsearch_jax.scene import Scene, SceneError


class Execution(NamedTuple):
    """Result of a simulated motion.

    Attributes:
      qpos: f32[nq] rad or m, joint values at the end.
      peak_torque: f32[nv] N m or N, largest magnitude of each joint's actuator force, gravity load included.
      energy: f32[] J, positive work of the actuators.
      time: f32[] s, simulated time at the end.
    """

    qpos: Array
    peak_torque: Array
    energy: Array
    time: Array


def check_drive(scene: Scene, arm: Arm) -> None:
    """Checks that each joint that moves the camera can be simulated: it has a position actuator and a speed limit.

    Args:
      scene: the scene.
      arm: the arm of the scene, from `build_arm`.

    Raises:
      SceneError: a joint has no position actuator.
      PlanningError: a joint has no speed limit.
    """
    check_speeds(arm)
    model = scene.mj_model
    is_joint = model.actuator_trntype == mujoco.mjtTrn.mjTRN_JOINT
    gain = model.actuator_gainprm[:, 0]
    is_position = (gain > 0.0) & np.isclose(model.actuator_biasprm[:, 1], -gain)
    driven = set(model.actuator_trnid[is_joint & is_position, 0].tolist())
    missing = ", ".join(model.joint(joint).name for joint in scene.joint_ids if joint not in driven)
    if missing:
        raise SceneError(
            f"joint {missing} has no position actuator, but EnvConfig.motion 'dynamic' needs one; add "
            "<position joint=... kp=... kv=.../> to the arm's file, or set EnvConfig.motion to 'kinematic'"
        )


def execute(arm: Arm, model: mjx.Model, trajectory: Trajectory, config: PlanningConfig) -> Execution:
    """Simulates the dynamics of the arm along a trajectory, and then `config.settling_time` in which it comes to rest.

    The commands lead the path by the lag of the actuators' damping, so a constant speed is followed without error.
    Contacts are not simulated, since planning has excluded them. If the trajectory lasts 0 s, the arm does not move.
    Under `vmap` the motions run one after another, because on CPU MJX is slow in a batch (see `robot.kinematics`).

    Args:
      arm: the arm.
      model: `Scene.mjx_model`. Each joint that moves the camera has a position actuator; see `check_drive`.
      trajectory: the timed motion, from `time_path`.
      config: `settling_time` in s.

    Returns:
      Joint values, peak torques, energy and time at the end.
    """
    return _simulate(arm, model, trajectory, jnp.float32(config.settling_time))


def pass_through(
    arm: Arm, model: mjx.Model, trajectory: Trajectory, config: PlanningConfig, times: Array
) -> tuple[Array, Array]:
    """Runs the simulation of `execute` and returns the joint values at given times.

    Args:
      arm: the arm.
      model: `Scene.mjx_model`. Each joint that moves the camera has a position actuator; see `check_drive`.
      trajectory: the timed motion, from `time_path`.
      config: `settling_time` in s.
      times: f32[F] s since the start, F ascending times. After the end of the motion the joint values stay constant.

    Returns:
      Joint values f32[F, nq] rad or m, one row for each time. Time f32[] s at which the arm is at rest.
    """
    total = _total_time(trajectory, config.settling_time)
    step = functools.partial(_step_dynamics, arm, model, trajectory)

    def simulate_until(data: mjx.Data, time: Array) -> tuple[mjx.Data, Array]:
        end = jnp.minimum(time, total)
        data = jax.lax.while_loop(lambda data: data.time < end, step, data)
        return data, data.qpos

    return jax.lax.scan(simulate_until, _start_data(arm, trajectory), times)[1], total


def _total_time(trajectory: Trajectory, settling_time: Array | float) -> Array:
    """Returns f32[] s from the start until the arm is at rest; 0 if it does not move."""
    seconds = duration(trajectory)
    return jnp.where(seconds > 0.0, seconds + settling_time, 0.0)


def _start_data(arm: Arm, trajectory: Trajectory) -> mjx.Data:
    return dataclasses.replace(arm.data, qpos=trajectory.waypoints[0])


def _step_dynamics(arm: Arm, model: mjx.Model, trajectory: Trajectory, data: mjx.Data) -> mjx.Data:
    """Returns the data one time step later."""
    gain, damping = model.actuator_gainprm[:, 0], -model.actuator_biasprm[:, 2]
    lead = damping / jnp.maximum(gain, 1e-9)
    in_qpos = jnp.asarray(model.jnt_qposadr)[jnp.asarray(model.actuator_trnid[:, 0])]
    joints, velocity = state_at(arm, trajectory, data.time)
    command = joints[in_qpos] + lead * velocity[in_qpos]
    # MJX relies on implicit promotion, which the tests forbid.
    with jax.numpy_rank_promotion("allow"), jax.numpy_dtype_promotion("standard"):
        return mjx.step(model, dataclasses.replace(data, ctrl=command))


@jax.custom_batching.sequential_vmap
def _simulate(arm: Arm, model: mjx.Model, trajectory: Trajectory, settling_time: Array) -> Execution:
    total = _total_time(trajectory, settling_time)

    def step(state: tuple[mjx.Data, Array, Array]) -> tuple[mjx.Data, Array, Array]:
        data, peak, energy = state
        data = _step_dynamics(arm, model, trajectory, data)
        torque = data.qfrc_actuator
        work = jnp.sum(jnp.maximum(torque * data.qvel, 0.0)) * model.opt.timestep
        return data, jnp.maximum(peak, jnp.abs(torque)), energy + work

    start = (_start_data(arm, trajectory), jnp.zeros(model.nv), jnp.zeros(()))
    data, peak, energy = jax.lax.while_loop(lambda state: state[0].time < total, step, start)
    return Execution(data.qpos, peak, energy, data.time)
