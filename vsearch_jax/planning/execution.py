"""Simulates a motion with the arm's dynamics: MJX steps, with position actuators that follow a timed path."""

from __future__ import annotations

import dataclasses
import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from mujoco import mjx

from vsearch_jax.config import PlanningConfig
from vsearch_jax.planning.drive import actuator_controls, start_data
from vsearch_jax.planning.trajectory import Trajectory, duration, state_at
from vsearch_jax.robot.arm import Arm


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


def execute(arm: Arm, model: mjx.Model, trajectory: Trajectory, config: PlanningConfig) -> Execution:
    """Simulates the dynamics of the arm along a trajectory, and then `config.settling_time` in which it comes to rest.

    The commands lead the path by the lag of the actuators' damping, so a constant speed is followed without error.
    Actuators that do not move the camera hold their lengths (see `planning.drive`).
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
    start, held = start_data(arm, model, trajectory.waypoints[0])
    step = functools.partial(_step_dynamics, arm, model, trajectory, held)

    def simulate_until(data: mjx.Data, time: Array) -> tuple[mjx.Data, Array]:
        end = jnp.minimum(time, total)
        data = jax.lax.while_loop(lambda data: data.time < end, step, data)
        return data, data.qpos

    return jax.lax.scan(simulate_until, start, times)[1], total


def _total_time(trajectory: Trajectory, settling_time: Array | float) -> Array:
    """Returns f32[] s from the start until the arm is at rest; 0 if it does not move."""
    seconds = duration(trajectory)
    return jnp.where(seconds > 0.0, seconds + settling_time, 0.0)


def _step_dynamics(arm: Arm, model: mjx.Model, trajectory: Trajectory, held: Array, data: mjx.Data) -> mjx.Data:
    """Returns the data one time step later. `held` are the lengths that actuators of tendons and sites hold."""
    command = actuator_controls(model, *state_at(arm, trajectory, data.time), held)
    # MJX relies on implicit promotion, which the tests forbid.
    with jax.numpy_rank_promotion("allow"), jax.numpy_dtype_promotion("standard"):
        return mjx.step(model, dataclasses.replace(data, ctrl=command))


@jax.custom_batching.sequential_vmap
def _simulate(arm: Arm, model: mjx.Model, trajectory: Trajectory, settling_time: Array) -> Execution:
    total = _total_time(trajectory, settling_time)

    def step(state: tuple[mjx.Data, Array, Array]) -> tuple[mjx.Data, Array, Array]:
        data, peak, energy = state
        data = _step_dynamics(arm, model, trajectory, held, data)
        torque = data.qfrc_actuator
        work = jnp.sum(jnp.maximum(torque * data.qvel, 0.0)) * model.opt.timestep
        return data, jnp.maximum(peak, jnp.abs(torque)), energy + work

    first, held = start_data(arm, model, trajectory.waypoints[0])
    start = (first, jnp.zeros(model.nv), jnp.zeros(()))
    data, peak, energy = jax.lax.while_loop(lambda state: state[0].time < total, step, start)
    return Execution(data.qpos, peak, energy, data.time)
