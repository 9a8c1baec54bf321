"""Timing of a path: rounded corners, then the fastest motion within speed and acceleration limits.

The path speed is computed on a grid in one forward and one backward pass, as in TOPP-RA (Pham and Pham, 2018). Half of
each joint's acceleration is reserved for the bends, which makes both passes running minima.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from vsearch_jax.config import PlanningConfig
from vsearch_jax.planning.proofs import evaluate_sample
from vsearch_jax.robot.arm import Arm
from vsearch_jax.types import Path

# Grid intervals on each straight piece and on each bend.
GRID = 16
# A bend takes at most this share of each straight piece beside it, and of the motion that is free of contact.
BEND_SHARE, FREE_SHARE = 0.45, 0.9
# Pieces shorter than this (rad) are treated as points.
TINY = 1e-6


class Trajectory(NamedTuple):
    """A timed motion along a path with rounded corners; see `time_path`.

    The pieces of the path are, in turn, a straight piece and the bend after it. Each has `GRID` intervals, which makes
    G intervals in all. W waypoints; J joints that move the camera.

    Attributes:
      waypoints: f32[W, nq] rad or m, of the path.
      radii: f32[W] rad, distance from each waypoint to both ends of its bend; 0 where there is no bend.
      tangents: f32[W - 1, J], unit vectors along the straight pieces.
      sizes: f32[G] rad, lengths of the intervals along the path.
      times: f32[G + 1] s, at the ends of the intervals.
      squared_speeds: f32[G + 1] rad^2/s^2, squares of the path speed at the ends of the intervals.
    """

    waypoints: Array
    radii: Array
    tangents: Array
    sizes: Array
    times: Array
    squared_speeds: Array


class PlanningError(ValueError):
    """A motion cannot be timed. The message names the joints and the remedy."""


class Motion(NamedTuple):
    """Cost of a motion of the arm.

    Attributes:
      is_found: bool[], whether a path was found. If not, the arm does not move, and the other fields are 0.
      travel: f32[] rad, length of the path in joint space; 1 m of a slide counts as 1 rad.
      duration: f32[] s, from rest to rest within the limits; NaN if the model gives no speed limits.
    """

    is_found: Array
    travel: Array
    duration: Array


class _StraightPieces(NamedTuple):
    """Straight pieces of a path: unit vectors f32[W - 1, J] and lengths f32[W - 1] rad; both 0 for tiny pieces."""

    unit: Array
    lengths: Array


class _PathLimits(NamedTuple):
    """Limits on the grid; G is `GRID` times the number of pieces.

    Attributes:
      sizes: f32[G] rad, lengths of the intervals. The bend after the last straight piece has length 0.
      squared_speeds: f32[G + 1] rad^2/s^2, upper limits of the squared path speed at the ends of the intervals.
      accelerations: f32[G] rad/s^2, upper limits of the path acceleration.
    """

    sizes: Array
    squared_speeds: Array
    accelerations: Array


def time_path(arm: Arm, path: Path, config: PlanningConfig) -> Trajectory:
    """Returns the fastest motion along `path` within the limits of speed and acceleration.

    The motion starts and ends at rest, and its velocity is continuous. Parabolas round the corners. A parabola stays so
    close to its corner that the arm stays free of contact. If the arm has no clearance at a corner, it stops there. The
    acceleration limit of a joint is its speed limit divided by `config.acceleration_time`.

    Args:
      arm: the arm.
      path: a path whose status is FOUND. For any other path the motion lasts 0 s and stays at the start.
      config: the acceleration time.

    Raises:
      PlanningError: the model gives no speed limit for a joint.
    """
    check_speeds(arm)
    pieces = _straight_pieces(path.waypoints[:, arm.chain.address])
    radii = _bend_radii(arm, path.waypoints, pieces)
    speed = arm.speed[arm.chain.address]
    limits = _path_limits(pieces, radii, speed, speed / config.acceleration_time)
    squared = _fastest_squared_speeds(limits)
    path_speed, sizes = jnp.sqrt(squared), limits.sizes
    durations = jnp.where(sizes > 0.0, 2.0 * sizes / jnp.maximum(path_speed[:-1] + path_speed[1:], 1e-9), 0.0)
    times = jnp.concatenate([jnp.zeros(1), jnp.cumsum(durations)])
    return Trajectory(path.waypoints, radii, pieces.unit, sizes, times, squared)


def check_speeds(arm: Arm) -> None:
    """Checks that each joint that moves the camera has a speed limit, which timing a motion needs.

    Raises:
      PlanningError: the model gives no speed limit for a joint.
    """
    if arm.joints_without_speed:
        names = ", ".join(arm.joints_without_speed)
        raise PlanningError(
            f"no speed limit for joint {names}: set the joint's `user` attribute in the arm's file, in rad/s (or m/s), "
            "above 0"
        )


def straight_duration(arm: Arm, start: Array, goal: Array, config: PlanningConfig) -> Array:
    """Returns f32[] s, the shortest time for the straight joint path from `start` to `goal`, from rest to rest.

    Each joint needs `config.acceleration_time` to reach its full speed. `time_path` gives a straight path the same
    time. The result is NaN if any joint that moves the camera has no speed limit.

    Args:
      arm: the arm, with the speed limits.
      start: f32[nq] rad or m, joint values at the start.
      goal: f32[nq] rad or m, joint values at the end.
      config: PlanningConfig; only `acceleration_time` is used.
    """
    address = arm.chain.address
    at_full_speed = jnp.max(jnp.abs(goal - start)[address] / arm.speed[address])
    ramp = config.acceleration_time
    # A short motion slows down before it reaches full speed.
    return jnp.where(at_full_speed > ramp, at_full_speed + ramp, 2.0 * jnp.sqrt(at_full_speed * ramp))


def duration(trajectory: Trajectory) -> Array:
    """Returns the time f32[] in s that the motion takes."""
    return trajectory.times[-1]


def state_at(arm: Arm, trajectory: Trajectory, time: Array) -> tuple[Array, Array]:
    """Returns the joint values and the joint velocities of a motion at one time.

    Args:
      arm: the arm.
      trajectory: the timed motion, from `time_path`.
      time: f32[] s since the start. Before the start and after the end the arm is at rest.

    Returns:
      Joint values f32[nq] rad or m. Joint velocities f32[nq] rad/s or m/s.
    """
    times, sizes = trajectory.times, trajectory.sizes
    inside = jnp.clip(time, 0.0, times[-1])
    index = jnp.clip(jnp.searchsorted(times, inside, side="right") - 1, 0, sizes.shape[0] - 1)
    size = jnp.maximum(sizes[index], 1e-12)
    acceleration = (trajectory.squared_speeds[index + 1] - trajectory.squared_speeds[index]) / (2.0 * size)
    speed = jnp.sqrt(trajectory.squared_speeds[index])
    since = inside - times[index]
    share = jnp.clip((speed * since + 0.5 * acceleration * since**2) / size, 0.0, 1.0)
    piece, place = index // GRID, ((index % GRID).astype(jnp.float32) + share) / GRID
    joints, tangent = _point_on_piece(arm, trajectory, piece, place)
    is_moving = (time >= 0.0) & (time < times[-1])
    velocity = jnp.where(is_moving, tangent * jnp.maximum(speed + acceleration * since, 0.0), 0.0)
    rest, address = trajectory.waypoints[0], arm.chain.address
    return rest.at[address].set(joints), jnp.zeros_like(rest).at[address].set(velocity)


def _point_on_piece(arm: Arm, trajectory: Trajectory, piece: Array, place: Array) -> tuple[Array, Array]:
    """Returns joints f32[J] and tangent f32[J] at `place` (f32[] in [0, 1]) on a piece; even pieces are straight."""
    points, unit, radii = trajectory.waypoints[:, arm.chain.address], trajectory.tangents, trajectory.radii
    line = piece // 2
    before, after = radii[line], radii[line + 1]
    start, end = points[line] + before * unit[line], points[line + 1] - after * unit[line]
    on_line = start + place * (end - start)
    following = unit[jnp.minimum(line + 1, unit.shape[0] - 1)]
    from_corner = after * (place**2 * following - (1.0 - place) ** 2 * unit[line])
    bend_tangent = (1.0 - place) * unit[line] + place * following
    is_straight = piece % 2 == 0
    return (
        jnp.where(is_straight, on_line, points[line + 1] + from_corner),
        jnp.where(is_straight, unit[line], bend_tangent),
    )


def _straight_pieces(points: Array) -> _StraightPieces:
    """Returns the straight pieces between waypoints f32[W, J]."""
    change = jnp.diff(points, axis=0)
    lengths = jnp.sqrt(jnp.maximum(jnp.sum(change * change, axis=-1), 1e-16))
    unit = jnp.where((lengths > TINY)[:, None], change / lengths[:, None], 0.0)
    return _StraightPieces(unit, jnp.where(lengths > TINY, lengths, 0.0))


def _bend_radii(arm: Arm, waypoints: Array, pieces: _StraightPieces) -> Array:
    """Returns f32[W] rad, distance from each waypoint to both ends of its bend; 0 at start and goal."""
    lengths = pieces.lengths
    gap = evaluate_sample(arm, waypoints[1:-1].T).gap.T
    rate = jnp.sum(arm.planning_pairs.levers[None] * jnp.abs(pieces.unit)[:, None], axis=-1)
    free = gap / jnp.maximum(jnp.maximum(rate[:-1], rate[1:]), 1e-9)
    free = FREE_SHARE * jnp.min(free, axis=-1, initial=jnp.inf)
    radius = jnp.minimum(jnp.minimum(lengths[:-1], lengths[1:]) * BEND_SHARE, jnp.maximum(free, 0.0))
    return jnp.concatenate([jnp.zeros(1), jnp.where(radius > TINY, radius, 0.0), jnp.zeros(1)])


def _path_limits(pieces: _StraightPieces, radii: Array, speed: Array, acceleration: Array) -> _PathLimits:
    """Converts joint limits, speed and acceleration (f32[J] each), into limits along the path.

    Inside, arrays have the axes [W - 1, 2 (straight piece, bend), GRID, J].
    """
    unit = pieces.unit
    speed, acceleration = (limit.reshape(1, 1, 1, -1) for limit in (speed, acceleration))
    following = jnp.concatenate([unit[1:], jnp.zeros((1, unit.shape[1]))])
    largest = _largest_tangents(unit, following)
    bend = radii[1:]
    curvature = jnp.abs(following - unit) / jnp.maximum(2.0 * bend, TINY)[:, None]
    curvature = jnp.stack([jnp.zeros_like(curvature), curvature], axis=1)[:, :, None]
    sizes = jnp.stack([pieces.lengths - radii[:-1] - bend, 2.0 * bend], axis=1) / GRID
    sizes = jnp.repeat(sizes[:, :, None], GRID, axis=2)
    squared = jnp.min((speed / jnp.maximum(largest, 1e-9)) ** 2, axis=-1)
    squared = jnp.minimum(squared, jnp.min(0.5 * acceleration / jnp.maximum(curvature, 1e-9), axis=-1))
    left = acceleration - curvature * squared[..., None]
    accelerations = jnp.min(left / jnp.maximum(largest, 1e-9), axis=-1)
    # The arm stops at a corner without a bend, because the direction jumps there.
    must_stop = jnp.stack([jnp.zeros_like(bend, bool), bend <= 0.0], axis=1)[:, :, None]
    inner = jnp.where(sizes > 0.0, squared, jnp.where(must_stop, 0.0, jnp.inf)).reshape(-1)
    squared_speeds = jnp.minimum(jnp.append(inner, 0.0), jnp.concatenate([jnp.zeros(1), inner]))
    return _PathLimits(sizes.reshape(-1), squared_speeds, jnp.where(sizes > 0.0, accelerations, 0.0).reshape(-1))


def _largest_tangents(unit: Array, following: Array) -> Array:
    """Returns f32[W - 1, 2, GRID, J], largest magnitude of each tangent component on each interval."""
    place = jnp.linspace(0.0, 1.0, GRID + 1)[None, :, None]
    on_bend = (1.0 - place) * unit[:, None] + place * following[:, None]
    tangents = jnp.stack([jnp.broadcast_to(unit[:, None], on_bend.shape), on_bend], axis=1)
    return jnp.maximum(jnp.abs(tangents[:, :, :-1]), jnp.abs(tangents[:, :, 1:]))


def _fastest_squared_speeds(limits: _PathLimits) -> Array:
    """Returns f32[G + 1] rad^2/s^2, the largest squared path speeds within all limits.

    A squared speed changes by at most 2 * acceleration * size over an interval. The forward pass applies this from the
    start on, the backward pass from the end on.
    """
    steps = jnp.concatenate([jnp.zeros(1), jnp.cumsum(2.0 * limits.sizes * limits.accelerations)])
    forward = steps + jax.lax.cummin(limits.squared_speeds - steps)
    backward = jax.lax.cummin(limits.squared_speeds + steps, reverse=True) - steps
    return jnp.maximum(jnp.minimum(forward, backward), 0.0)
