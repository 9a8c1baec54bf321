"""A motion as the arm's dynamics would do it: MJX steps under position actuators that follow a timed path."""

from __future__ import annotations

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array
from mujoco import mjx

from vsearch_jax.config import PlanningConfig
from vsearch_jax.planning import check_speeds, duration, state_at
from vsearch_jax.planning.trajectory import Trajectory
from vsearch_jax.robot.arm import Arm
from vsearch_jax.scene import Scene, SceneError


class Execution(NamedTuple):
    """What came of a motion.

    Attributes:
      qpos: f32[nq] rad or m, where the arm came to stand.
      peak_torque: f32[nv] N m or N, most that the actuators gave, its weight included.
      energy: f32[] J, of the actuators, where they push.
      time: f32[] s.
    """

    qpos: Array
    peak_torque: Array
    energy: Array
    time: Array


def check_drive(scene: Scene, arm: Arm) -> None:
    """Checks that each joint that moves the camera can be driven.

    Raises:
      SceneError: a joint has no position actuator of its own.
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
            f"joint {missing} has no position actuator, which EnvConfig.motion 'dynamic' needs; add "
            "<position joint=... kp=... kv=.../> to the arm's file, or choose motion 'kinematic'"
        )


def execute(arm: Arm, model: mjx.Model, trajectory: Trajectory, config: PlanningConfig) -> Execution:
    """Returns what comes of following `trajectory` and then `config.settling_time` of rest.

    The commands lead the path by what the actuators' damping makes them lag, so that a steady speed is followed without
    error. Contacts are not simulated: planning has excluded them. An arm whose motion lasts no time stays where it is.
    Under `vmap` the motions run one after another, since MJX's chain of bodies is slow when batched on CPU (see
    `kinematics`).

    Args:
      arm: the arm.
      model: `Scene.mjx_model`; each joint of the camera's chain has a position actuator.
      trajectory: of `planning.time_path`.
      config: the settling time.
    """
    return _run(arm, model, trajectory, jnp.float32(config.settling_time))


def pass_through(
    arm: Arm, model: mjx.Model, trajectory: Trajectory, config: PlanningConfig, times: Array
) -> tuple[Array, Array]:
    """Returns where the arm is at each of `times` while it does what `execute` does.

    Args:
      arm: see `execute`.
      model: see `execute`.
      trajectory: see `execute`.
      config: see `execute`.
      times: f32[F] s since the start, rising; from the end of the motion on, the arm is where `execute` leaves it.

    Returns:
      Joints f32[F, nq] rad or m, and f32[] s, when the arm has come to stand.
    """
    total = _total(trajectory, config.settling_time)

    def go_on(data: mjx.Data, time: Array) -> tuple[mjx.Data, Array]:
        end = jnp.minimum(time, total)
        data = jax.lax.while_loop(
            lambda data: data.time < end, functools.partial(_follow, arm, model, trajectory), data
        )
        return data, data.qpos

    return jax.lax.scan(go_on, _at_start(arm, trajectory), times)[1], total


def _total(trajectory: Trajectory, settling_time: Array | float) -> Array:
    """Returns f32[] s until the arm has settled, 0 where it does not move."""
    seconds = duration(trajectory)
    return jnp.where(seconds > 0.0, seconds + settling_time, 0.0)


def _at_start(arm: Arm, trajectory: Trajectory) -> mjx.Data:
    return arm.data.replace(qpos=trajectory.waypoints[0])


def _follow(arm: Arm, model: mjx.Model, trajectory: Trajectory, data: mjx.Data) -> mjx.Data:
    """Returns the data one step of the dynamics later."""
    gain, damping = model.actuator_gainprm[:, 0], -model.actuator_biasprm[:, 2]
    lead = damping / jnp.maximum(gain, 1e-9)
    in_qpos = jnp.asarray(model.jnt_qposadr)[jnp.asarray(model.actuator_trnid[:, 0])]
    joints, velocity = state_at(arm, trajectory, data.time)
    command = joints[in_qpos] + lead * velocity[in_qpos]
    with jax.numpy_rank_promotion("allow"), jax.numpy_dtype_promotion("standard"):  # mjx promotes freely
        return mjx.step(model, data.replace(ctrl=command))


@jax.custom_batching.sequential_vmap
def _run(arm: Arm, model: mjx.Model, trajectory: Trajectory, settling_time: Array) -> Execution:
    total = _total(trajectory, settling_time)

    def step(state: tuple[mjx.Data, Array, Array]) -> tuple[mjx.Data, Array, Array]:
        data, peak, energy = state
        data = _follow(arm, model, trajectory, data)
        torque = data.qfrc_actuator
        work = jnp.sum(jnp.maximum(torque * data.qvel, 0.0)) * model.opt.timestep
        return data, jnp.maximum(peak, jnp.abs(torque)), energy + work

    start = (_at_start(arm, trajectory), jnp.zeros(model.nv), jnp.zeros(()))
    data, peak, energy = jax.lax.while_loop(lambda state: state[0].time < total, step, start)
    return Execution(data.qpos, peak, energy, data.time)
