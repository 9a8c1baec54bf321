"""The reachability map: which views of a grid the arm can reach, and joints for each of them."""

from __future__ import annotations

import dataclasses
import functools
import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jaxlie import SE3

from vsearch_jax.config import IKConfig
from vsearch_jax.geometry import view_pose, wrap_angle
from vsearch_jax.planning import lane_counts
from vsearch_jax.planning.starts import ik_from_starts, ranking_cost, solve_starts, start_limits
from vsearch_jax.robot.arm import Arm
from vsearch_jax.types import IKResult, ReachabilityMap, View

# Each round solves every cell from new random starts, from the cell's own joints and from those of its four neighbours.
NUM_ROUNDS = 4


class _Grid(NamedTuple):
    """Camera poses of the map's views, leading axes [A, E], and the limits f32[nq] rad or m of the random starts."""

    poses: SE3
    lower: Array
    upper: Array


def reachability_map(arm: Arm, center: Array, radius: float | Array, config: IKConfig, key: Array) -> ReachabilityMap:
    """Finds out which views of a grid the arm reaches, and solves the inverse kinematics of each of them.

    A view is a camera position (azimuth, elevation) on the view sphere around the object. A cell is one view of the
    grid. Each cell is solved from random starts in several rounds. Every round also tries the joints of the four
    neighbouring cells, so a cell that the random starts missed is solved from a neighbour. A solution is valid if it
    converged, inside the joint limits and without contact. A cell keeps the valid solution farthest from the joint
    limits. Joints that do not move the camera stay at `arm.home`. The function can be traced.

    Args:
      arm: the arm.
      center: f32[3] m in world, centre of the view sphere.
      radius: f32[] m, radius of the view sphere.
      config: size of the grid, number of starts and iterations.
      key: PRNG key of the random starts.

    Returns:
      The map. Its `band` (lowest and highest elevation that is reachable at every azimuth) is NaN if there is none.
    """
    azimuths = jnp.arange(config.map_azimuths, dtype=jnp.float32) * (2.0 * jnp.pi / config.map_azimuths)
    elevations = jnp.linspace(0.0, jnp.pi / 2.0, config.map_elevations)
    shape = (config.map_azimuths, config.map_elevations)
    views = View(*jnp.meshgrid(azimuths, elevations, indexing="ij"))
    poses = jax.vmap(jax.vmap(view_pose, in_axes=(0, None, None)), in_axes=(0, None, None))(views, center, radius)
    grid = _Grid(poses, *start_limits(arm))
    start = (jnp.broadcast_to(arm.home, (*shape, *arm.home.shape)), jnp.zeros(shape, bool))
    config = dataclasses.replace(config, num_iterations=config.map_iterations)
    body = functools.partial(_solve_round, arm, grid, config, key)
    qpos, is_reachable = jax.lax.fori_loop(0, NUM_ROUNDS, body, start)
    return ReachabilityMap(
        azimuths=azimuths,
        elevations=elevations,
        is_reachable=is_reachable,
        qpos=qpos,
        band=_widest_band(is_reachable, elevations),
    )


def nearest_cell(reach: ReachabilityMap, view: View) -> tuple[Array, Array]:
    """Finds the reachable view of the map's grid that is nearest to `view`.

    If no view of the grid is reachable, it is the nearest of all views of the grid.

    Args:
      reach: reachability map of the arm.
      view: azimuth and elevation, f32[] rad each.

    Returns:
      Index of its azimuth, i32[], and index of its elevation, i32[], in the map.
    """
    azimuth = wrap_angle(reach.azimuths - view.azimuth) * jnp.cos(view.elevation)
    elevation = reach.elevations - view.elevation
    distance = azimuth[:, None] ** 2 + elevation[None, :] ** 2
    cell = jnp.argmin(jnp.where(reach.is_reachable, distance, 1e3 + distance))
    row, column = jnp.unravel_index(cell, distance.shape)
    return row, column


def solve_view(
    arm: Arm, reach: ReachabilityMap, view: View, qpos: Array, sphere: tuple[Array, float | Array], config: IKConfig
) -> tuple[IKResult, Array]:
    """Returns joints near the present joints with which the camera is at `view`, and whether the arm reaches the view.

    Inverse kinematics starts from the present joints, and from the joints of the nearest reachable view of the map.

    Args:
      arm: the arm.
      reach: reachability map of the arm.
      view: azimuth and elevation of the camera on the view sphere, f32[] rad each.
      qpos: f32[nq] rad or m, the present joints.
      sphere: centre f32[3] m in world, and radius f32[] m, of the view sphere.
      config: iterations, damping and tolerances.

    Returns:
      The solution. bool[], true if it converged, inside the joint limits and without contact.
    """
    starts = jnp.stack([qpos, reach.qpos[nearest_cell(reach, view)]])
    return ik_from_starts(arm, view_pose(view, *sphere), starts, qpos, config)


def _solve_round(
    arm: Arm, grid: _Grid, config: IKConfig, key: Array, index: Array, found: tuple[Array, Array]
) -> tuple[Array, Array]:
    """Returns joints f32[A, E, nq] and bool[A, E] whether the cell is reachable, after round `index`."""
    qpos, _ = found
    num_random = -(-config.map_seeds // NUM_ROUNDS)
    shape = (*qpos.shape[:2], num_random, qpos.shape[2])
    random_starts = jax.random.uniform(jax.random.fold_in(key, index), shape, minval=grid.lower, maxval=grid.upper)
    starts = jnp.concatenate([_with_neighbours(qpos), random_starts], axis=2)
    batch_size = _azimuths_at_once(qpos.shape[0])
    return jax.lax.map(functools.partial(_solve_azimuth, arm, config), (grid.poses, starts), batch_size=batch_size)


def _azimuths_at_once(num_azimuths: int) -> int:
    """Returns a divisor of `num_azimuths`, since `jax.lax.map` compiles the rest of a division separately."""
    limit = lane_counts.current().azimuths
    return num_azimuths if limit is None else math.gcd(num_azimuths, limit)


def _solve_azimuth(arm: Arm, config: IKConfig, row: tuple[SE3, Array]) -> tuple[Array, Array]:
    return jax.vmap(functools.partial(_solve_cell, arm, config))(*row)


def _solve_cell(arm: Arm, config: IKConfig, pose: SE3, starts: Array) -> tuple[Array, Array]:
    """Returns the best joints f32[nq] of a cell, and bool[] whether they are valid."""
    results, is_valid = solve_starts(arm, pose, starts, arm.home, config)
    address = arm.chain.address
    joints = results.qpos[:, address]
    lower, upper = (limit[address][None] for limit in start_limits(arm))
    margin = jnp.min(jnp.minimum(joints - lower, upper - joints) / (upper - lower), axis=-1)
    best = jnp.argmin(ranking_cost(results, is_valid, -margin))
    return results.qpos[best], is_valid[best]


def _with_neighbours(qpos: Array) -> Array:
    """Returns f32[A, E, 5, nq]: the joints of each cell and of its four neighbours. Azimuths are periodic."""
    below = jnp.concatenate([qpos[:, :1], qpos[:, :-1]], axis=1)
    above = jnp.concatenate([qpos[:, 1:], qpos[:, -1:]], axis=1)
    return jnp.stack([qpos, jnp.roll(qpos, 1, axis=0), jnp.roll(qpos, -1, axis=0), below, above], axis=2)


def _widest_band(is_reachable: Array, elevations: Array) -> Array:
    """Returns f32[2] rad, ends of the longest run of elevations that are reachable at every azimuth; NaN if none."""
    is_everywhere = jnp.all(is_reachable, axis=0)
    _, lengths = jax.lax.scan(_run_length, jnp.int32(0), is_everywhere)
    end = jnp.argmax(lengths)
    band = jnp.stack([elevations[end - lengths[end] + 1], elevations[end]])
    return jnp.where(lengths[end] > 0, band, jnp.nan)


def _run_length(length: Array, is_everywhere: Array) -> tuple[Array, Array]:
    length = jnp.where(is_everywhere, length + 1, 0)
    return length, length
