"""Which views the arm can reach, on a grid over the view sphere, and joints for each of them."""

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
from vsearch_jax.planning.starts import ik_from_starts, rank, solve_starts, start_limits
from vsearch_jax.robot.arm import Arm
from vsearch_jax.types import IKResult, ReachabilityMap, View

# Every round solves each cell from new random starts, from its own joints and from those of its four neighbours.
NUM_ROUNDS = 4
# Azimuths solved at once: 12 of 19 elevations and 11 starts take about 60 MB.
MOST_AZIMUTHS = 12


class _Grid(NamedTuple):
    """The poses of the map's views, leading axes [A, E], and the limits f32[nq] of the random starts."""

    poses: SE3
    lower: Array
    upper: Array


def reachability_map(arm: Arm, center: Array, radius: float | Array, config: IKConfig, key: Array) -> ReachabilityMap:
    """Solves the inverse kinematics of every view of the grid; traceable, the fingers stay at home.

    Each cell is solved from random starts, in rounds; in each, the joints of its four neighbours are tried too, so that
    a cell that chance has missed is found from beside it. Of the valid solutions a cell keeps the one farthest from the
    joint limits.

    Args:
      arm: the arm.
      center: f32[3] m in world, the middle of the view sphere.
      radius: f32[] m.
      config: size of the grid, starts and iterations.
      key: PRNG key of the random starts.

    Returns:
      The map; its band is NaN where no elevation is reachable at every azimuth.
    """
    azimuths = jnp.arange(config.map_azimuths, dtype=jnp.float32) * (2.0 * jnp.pi / config.map_azimuths)
    elevations = jnp.linspace(0.0, jnp.pi / 2.0, config.map_elevations)
    shape = (config.map_azimuths, config.map_elevations)
    views = View(*jnp.meshgrid(azimuths, elevations, indexing="ij"))
    poses = jax.vmap(jax.vmap(view_pose, in_axes=(0, None, None)), in_axes=(0, None, None))(views, center, radius)
    grid = _Grid(poses, *start_limits(arm))
    start = (jnp.broadcast_to(arm.home, (*shape, *arm.home.shape)), jnp.zeros(shape, bool))
    body = functools.partial(_round, arm, grid, dataclasses.replace(config, num_iterations=config.map_iterations), key)
    qpos, is_reachable = jax.lax.fori_loop(0, NUM_ROUNDS, body, start)
    return ReachabilityMap(
        azimuths=azimuths,
        elevations=elevations,
        is_reachable=is_reachable,
        qpos=qpos,
        band=_band(is_reachable, elevations),
    )


def nearest_cell(reach: ReachabilityMap, view: View) -> tuple[Array, Array]:
    """Returns i32[] azimuth and elevation index of the reachable cell nearest to `view`, of any where none is."""
    azimuth = wrap_angle(reach.azimuths - view.azimuth) * jnp.cos(view.elevation)
    elevation = reach.elevations - view.elevation
    distance = azimuth[:, None] ** 2 + elevation[None, :] ** 2
    cell = jnp.argmin(jnp.where(reach.is_reachable, distance, 1e3 + distance))
    row, column = jnp.unravel_index(cell, distance.shape)
    return row, column


def solve_view(
    arm: Arm, reach: ReachabilityMap, view: View, qpos: Array, sphere: tuple[Array, float | Array], config: IKConfig
) -> tuple[IKResult, Array]:
    """Returns joints for `view`, near the present ones, and bool[] whether the arm reaches it.

    Starts are the present joints and those of the map's nearest cell.

    Args:
      arm: the arm.
      reach: the arm's map.
      view: View of f32[] rad.
      qpos: f32[nq] rad or m, the present joints.
      sphere: centre f32[3] m in world, and radius f32[] m.
      config: iterations, damping and tolerances.
    """
    starts = jnp.stack([qpos, reach.qpos[nearest_cell(reach, view)]])
    return ik_from_starts(arm, view_pose(view, *sphere), starts, qpos, config)


def _round(
    arm: Arm, grid: _Grid, config: IKConfig, key: Array, index: Array, found: tuple[Array, Array]
) -> tuple[Array, Array]:
    qpos, _ = found
    num_random = -(-config.map_seeds // NUM_ROUNDS)
    shape = (*qpos.shape[:2], num_random, qpos.shape[2])
    random_starts = jax.random.uniform(jax.random.fold_in(key, index), shape, minval=grid.lower, maxval=grid.upper)
    starts = jnp.concatenate([_with_neighbours(qpos), random_starts], axis=2)
    # Some azimuths at a time bound the memory; their number divides that of all, else the rest would be compiled apart.
    batch_size = math.gcd(qpos.shape[0], MOST_AZIMUTHS)
    return jax.lax.map(functools.partial(_solve_row, arm, config), (grid.poses, starts), batch_size=batch_size)


def _solve_row(arm: Arm, config: IKConfig, row: tuple[SE3, Array]) -> tuple[Array, Array]:
    return jax.vmap(functools.partial(_solve_cell, arm, config))(*row)


def _solve_cell(arm: Arm, config: IKConfig, pose: SE3, starts: Array) -> tuple[Array, Array]:
    results, is_valid = solve_starts(arm, pose, starts, arm.home, config)
    address = arm.chain.address
    joints = results.qpos[:, address]
    lower, upper = (limit[address][None] for limit in start_limits(arm))
    margin = jnp.min(jnp.minimum(joints - lower, upper - joints) / (upper - lower), axis=-1)
    best = jnp.argmin(rank(results, is_valid, -margin))
    return results.qpos[best], is_valid[best]


def _with_neighbours(qpos: Array) -> Array:
    """Returns f32[A, E, 5, nq]: each cell's joints and those of the cells beside it, azimuths being periodic."""
    below = jnp.concatenate([qpos[:, :1], qpos[:, :-1]], axis=1)
    above = jnp.concatenate([qpos[:, 1:], qpos[:, -1:]], axis=1)
    return jnp.stack([qpos, jnp.roll(qpos, 1, axis=0), jnp.roll(qpos, -1, axis=0), below, above], axis=2)


def _band(is_reachable: Array, elevations: Array) -> Array:
    is_whole = jnp.all(is_reachable, axis=0)
    _, lengths = jax.lax.scan(_run_length, jnp.int32(0), is_whole)
    end = jnp.argmax(lengths)
    band = jnp.stack([elevations[end - lengths[end] + 1], elevations[end]])
    return jnp.where(lengths[end] > 0, band, jnp.nan)


def _run_length(length: Array, is_whole: Array) -> tuple[Array, Array]:
    length = jnp.where(is_whole, length + 1, 0)
    return length, length
