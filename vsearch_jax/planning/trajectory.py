"""When to be where on a path: rounded corners, then the fastest motion inside speed and acceleration limits.

Path speed is found on a grid in one forward and one backward pass, as in TOPP-RA (Pham and Pham, 2018), but with half
of each joint's acceleration kept for the bends, so that both passes are running minima.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from vsearch_jax.config import PlanningConfig
from vsearch_jax.planning.proofs import look
from vsearch_jax.robot.arm import Arm
from vsearch_jax.types import Path

# Intervals of the grid on each straight piece and on each bend.
GRID = 16
# A bend takes up to this share of the straight pieces beside it, and of the way that is free of contact.
BEND_SHARE, FREE_SHARE = 0.45, 0.9
# Shorter pieces (rad) count as nothing.
TINY = 1e-6


class Trajectory(NamedTuple):
    """A timed motion along a path with rounded corners; see `vsearch_jax.planning.time_path`. G grid intervals.

    Attributes:
      waypoints: f32[W, nq] rad or m, of the path.
      radii: f32[W] rad, how far before and after each waypoint its bend begins and ends.
      tangents: f32[W - 1, J], unit vectors along the straight pieces, of the joints that move the camera.
      sizes: f32[G] rad, of the intervals along the path.
      times: f32[G + 1] s, at their ends.
      squared_speeds: f32[G + 1] rad^2/s^2, of the path there.
    """

    waypoints: Array
    radii: Array
    tangents: Array
    sizes: Array
    times: Array
    squared_speeds: Array


class PlanningError(ValueError):
    """A motion cannot be timed; the message names the joints and the remedy."""


class Motion(NamedTuple):
    """What a motion of the arm costs.

    Attributes:
      is_found: bool[]; else the arm stays, and the rest is 0.
      travel: f32[] rad, way in joint space (m of slides count alike).
      duration: f32[] s, from rest to rest within the limits; NaN for an arm whose model gives no speeds.
    """

    is_found: Array
    travel: Array
    duration: Array


def time_path(arm: Arm, path: Path, config: PlanningConfig) -> Trajectory:
    """Returns the motion along `path`, from rest to rest, with continuous velocity.

    Corners are rounded by parabolas. How far a parabola leaves the path is bounded by the distance that the arm keeps
    from everything at the corner, so that what was free stays free; where that is nothing, the arm stops. Accelerations
    are bounded by the speed limits over `config.acceleration_time`.

    Args:
      arm: the arm.
      path: a path that was found; without one the motion lasts no time and stays at the start.
      config: the acceleration time.

    Raises:
      PlanningError: the model gives no speed limit for a joint.
    """
    check_speeds(arm)
    points = path.waypoints[:, arm.chain.address]
    change = jnp.diff(points, axis=0)
    lengths = jnp.sqrt(jnp.maximum(jnp.sum(change * change, axis=-1), 1e-16))
    unit = jnp.where((lengths > TINY)[:, None], change / lengths[:, None], 0.0)
    lengths = jnp.where(lengths > TINY, lengths, 0.0)
    radii = _bend_radii(arm, path.waypoints, unit, lengths)
    blank = Trajectory(path.waypoints, radii, unit, jnp.zeros(0), jnp.zeros(0), jnp.zeros(0))
    limit = arm.speed[arm.chain.address]
    sizes, caps, pushes = _limits(blank, lengths, limit, limit / config.acceleration_time)
    # Squared path speed at the grid points: what they allow, and what the way from the others allows.
    steps = jnp.concatenate([jnp.zeros(1), jnp.cumsum(2.0 * sizes * pushes)])
    forward = steps + jax.lax.cummin(caps - steps)
    backward = jax.lax.cummin(caps + steps, reverse=True) - steps
    squared = jnp.maximum(jnp.minimum(forward, backward), 0.0)
    speed = jnp.sqrt(squared)
    durations = jnp.where(sizes > 0.0, 2.0 * sizes / jnp.maximum(speed[:-1] + speed[1:], 1e-9), 0.0)
    times = jnp.concatenate([jnp.zeros(1), jnp.cumsum(durations)])
    return blank._replace(sizes=sizes, times=times, squared_speeds=squared)


def check_speeds(arm: Arm) -> None:
    """Checks that each joint that moves the camera has a speed limit.

    Raises:
      PlanningError: the model gives none for a joint.
    """
    if arm.joints_without_speed:
        names = ", ".join(arm.joints_without_speed)
        raise PlanningError(f"no speed limit for joint {names}: give the joint's `user` in rad/s (or m/s), above 0")


def straight_duration(arm: Arm, start: Array, goal: Array, config: PlanningConfig) -> Array:
    """Returns f32[] s: how long the straight motion takes from rest to rest, as `time_path` times it.

    Args:
      arm: the arm; NaN comes back where a joint of the chain has no speed limit.
      start: f32[nq] rad or m.
      goal: f32[nq] rad or m.
      config: the acceleration time.
    """
    address = arm.chain.address
    at_full_speed = jnp.max(jnp.abs(goal - start)[address] / arm.speed[address])
    ramp = config.acceleration_time
    # Short motions turn from speeding up to slowing down before they are at full speed.
    return jnp.where(at_full_speed > ramp, at_full_speed + ramp, 2.0 * jnp.sqrt(at_full_speed * ramp))


def duration(trajectory: Trajectory) -> Array:
    """Returns f32[] s."""
    return trajectory.times[-1]


def state_at(arm: Arm, trajectory: Trajectory, time: Array) -> tuple[Array, Array]:
    """Returns joints f32[nq] (rad or m) and their velocity f32[nq] at `time` (f32[] s); at rest before and after."""
    times, sizes = trajectory.times, trajectory.sizes
    inside = jnp.clip(time, 0.0, times[-1])
    index = jnp.clip(jnp.searchsorted(times, inside, side="right") - 1, 0, sizes.shape[0] - 1)
    size = jnp.maximum(sizes[index], 1e-12)
    push = (trajectory.squared_speeds[index + 1] - trajectory.squared_speeds[index]) / (2.0 * size)
    speed = jnp.sqrt(trajectory.squared_speeds[index])
    since = inside - times[index]
    share = jnp.clip((speed * since + 0.5 * push * since**2) / size, 0.0, 1.0)
    piece, place = index // GRID, ((index % GRID).astype(jnp.float32) + share) / GRID
    joints, tangent = _at(arm, trajectory, piece, place)
    is_moving = (time >= 0.0) & (time < times[-1])
    velocity = jnp.where(is_moving, tangent * jnp.maximum(speed + push * since, 0.0), 0.0)
    rest, address = trajectory.waypoints[0], arm.chain.address
    return rest.at[address].set(joints), jnp.zeros_like(rest).at[address].set(velocity)


def _at(arm: Arm, trajectory: Trajectory, piece: Array, place: Array) -> tuple[Array, Array]:
    """Returns joints f32[J] and unit tangent f32[J] on a piece, at `place` in [0, 1]; even pieces are straight."""
    points, unit, radii = trajectory.waypoints[:, arm.chain.address], trajectory.tangents, trajectory.radii
    line = piece // 2
    before, after = radii[line], radii[line + 1]
    start, end = points[line] + before * unit[line], points[line + 1] - after * unit[line]
    straight = start + place * (end - start)
    following = unit[jnp.minimum(line + 1, unit.shape[0] - 1)]
    away = after * (place**2 * following - (1.0 - place) ** 2 * unit[line])
    turning = (1.0 - place) * unit[line] + place * following
    is_straight = piece % 2 == 0
    return (
        jnp.where(is_straight, straight, points[line + 1] + away),
        jnp.where(is_straight, unit[line], turning),
    )


def _bend_radii(arm: Arm, waypoints: Array, unit: Array, lengths: Array) -> Array:
    """Returns f32[W]: how far in rad before and after each waypoint its bend begins and ends; 0 at both ends."""
    gap = look(arm, waypoints[1:-1].T).gap.T
    rate = jnp.sum(arm.planning_pairs.levers[None] * jnp.abs(unit)[:, None], axis=-1)
    room = gap / jnp.maximum(jnp.maximum(rate[:-1], rate[1:]), 1e-9)
    free = FREE_SHARE * jnp.min(room, axis=-1, initial=jnp.inf)
    radius = jnp.minimum(jnp.minimum(lengths[:-1], lengths[1:]) * BEND_SHARE, jnp.maximum(free, 0.0))
    return jnp.concatenate([jnp.zeros(1), jnp.where(radius > TINY, radius, 0.0), jnp.zeros(1)])


def _limits(shape: Trajectory, lengths: Array, speed: Array, acceleration: Array) -> tuple[Array, Array, Array]:
    """Returns sizes f32[G], caps of the squared path speed f32[G + 1], and of the path acceleration f32[G].

    G is `GRID` times the pieces: each straight one, and the bend after it (of no size after the last).
    """
    unit, radii = shape.tangents, shape.radii
    speed, acceleration = (limit.reshape(1, 1, 1, -1) for limit in (speed, acceleration))
    following = jnp.concatenate([unit[1:], jnp.zeros((1, unit.shape[1]))])
    place = jnp.linspace(0.0, 1.0, GRID + 1)[None, :, None]
    turning = (1.0 - place) * unit[:, None] + place * following[:, None]
    tangents = jnp.stack([jnp.broadcast_to(unit[:, None], turning.shape), turning], axis=1)
    largest = jnp.maximum(jnp.abs(tangents[:, :, :-1]), jnp.abs(tangents[:, :, 1:]))
    bend = radii[1:]
    curvature = jnp.abs(following - unit) / jnp.maximum(2.0 * bend, TINY)[:, None]
    curvature = jnp.stack([jnp.zeros_like(curvature), curvature], axis=1)[:, :, None]
    sizes = jnp.stack([lengths - radii[:-1] - bend, 2.0 * bend], axis=1) / GRID
    sizes = jnp.repeat(sizes[:, :, None], GRID, axis=2)
    squared = jnp.min((speed / jnp.maximum(largest, 1e-9)) ** 2, axis=-1)
    squared = jnp.minimum(squared, jnp.min(0.5 * acceleration / jnp.maximum(curvature, 1e-9), axis=-1))
    left = acceleration - curvature * squared[..., None]
    pushes = jnp.min(left / jnp.maximum(largest, 1e-9), axis=-1)
    # Without a bend the direction jumps.
    must_stop = jnp.stack([jnp.zeros_like(bend, bool), bend <= 0.0], axis=1)[:, :, None]
    inner = jnp.where(sizes > 0.0, squared, jnp.where(must_stop, 0.0, jnp.inf)).reshape(-1)
    caps = jnp.minimum(jnp.append(inner, 0.0), jnp.concatenate([jnp.zeros(1), inner]))
    return sizes.reshape(-1), caps, jnp.where(sizes > 0.0, pushes, 0.0).reshape(-1)
