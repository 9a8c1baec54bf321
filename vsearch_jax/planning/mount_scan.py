"""Finds the mount height from which an arm reaches most of the wanted views."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from vsearch_jax.config import Config, IKConfig
from vsearch_jax.planning.reachability import reachability_map, solve_view
from vsearch_jax.robot.arm import Arm, build_arm
from vsearch_jax.scene import build_scene
from vsearch_jax.types import ReachabilityMap, View

_SAME_DEG = 1e-3
"""Elevations that differ by less are the same, in degrees."""


class Mount(NamedTuple):
    """A height of the arm's mount, and the views that the arm reaches from it.

    Attributes:
      height: height of the arm's base above the table, in m.
      reach: ReachabilityMap at this height.
      coverage: share in [0, 1] of the wanted views that are reachable.
    """

    height: float
    reach: ReachabilityMap
    coverage: float


def scan_mounts(config: Config, heights: Sequence[float], band_deg: tuple[float, float], seed: int = 0) -> list[Mount]:
    """Computes, for each height of the arm's mount, which views of the object the arm reaches.

    Args:
      config: arm, object, view sphere and sizes of the reachability map.
      heights: heights of the arm's base above the table, in m.
      band_deg: lowest and highest elevation in degrees of the wanted views.
      seed: seed of the random starts of the inverse kinematics.

    Returns:
      One Mount for each height, in the order of `heights`.

    Raises:
      SceneError: arm or object cannot be loaded.
    """
    ends = jnp.deg2rad(jnp.asarray(ends_between_rows(config.ik, band_deg), jnp.float32))

    @jax.jit
    def solve(arm: Arm, center: Array, radius: Array, key: Array) -> tuple[ReachabilityMap, Array]:
        reach = reachability_map(arm, center, radius, config.ik, key)
        return reach, _are_rows_reachable(arm, reach, ends, (center, radius), config.ik)

    mounts = []
    for height in heights:
        scene = build_scene(dataclasses.replace(config.scene, mount_height=height))
        # The number of planning pairs depends on the height. Without them one compilation serves all heights.
        arm = dataclasses.replace(build_arm(scene), planning_pairs=None)
        center = jnp.asarray(scene.center, jnp.float32)
        reach, is_end_reachable = solve(arm, center, jnp.float32(scene.radius), jax.random.key(seed))
        mounts.append(Mount(height, reach, coverage(reach, band_deg, np.asarray(is_end_reachable))))
    return mounts


def ends_between_rows(config: IKConfig, band_deg: tuple[float, float]) -> list[float]:
    """Returns the ends of a band of elevations, in degrees, that are no elevation of the reachability map's grid.

    Args:
      config: size of the grid.
      band_deg: lowest and highest elevation in degrees.
    """
    rows = np.linspace(0.0, 90.0, config.map_elevations)
    return [end for end in sorted(set(band_deg)) if np.abs(rows - end).min() > _SAME_DEG]


def _are_rows_reachable(
    arm: Arm, reach: ReachabilityMap, elevations: Array, sphere: tuple[Array, Array], config: IKConfig
) -> Array:
    """Returns bool[A, K], whether the arm reaches the views at the map's A azimuths and K elevations in rad."""

    def is_reachable(azimuth: Array, elevation: Array) -> Array:
        return solve_view(arm, reach, View(azimuth, elevation), arm.home, sphere, config)[1]

    if elevations.size == 0:
        return jnp.zeros((reach.azimuths.size, 0), bool)
    return jax.vmap(jax.vmap(is_reachable, in_axes=(None, 0)), in_axes=(0, None))(reach.azimuths, elevations)


def coverage(reach: ReachabilityMap, band_deg: tuple[float, float], is_end_reachable: np.ndarray) -> float:
    """Returns the share in [0, 1] of the wanted views that the arm reaches.

    The wanted views are the views of the map's grid in a band of elevations, and those at the ends of the band.

    Args:
      reach: reachability map of the arm, with A azimuths.
      band_deg: lowest and highest elevation in degrees, both included.
      is_end_reachable: bool[A, K], whether the arm reaches the views at the ends of the band that the grid lacks; see
        `ends_between_rows`.
    """
    elevations = np.rad2deg(np.asarray(reach.elevations))
    is_wanted = (elevations >= band_deg[0] - _SAME_DEG) & (elevations <= band_deg[1] + _SAME_DEG)
    return float(np.concatenate([np.asarray(reach.is_reachable)[:, is_wanted], is_end_reachable], axis=1).mean())


def best_mount(mounts: Sequence[Mount]) -> Mount:
    """Returns the mount height with the highest coverage.

    If several heights are equal, it is the middle one of them. That one is farthest from heights with lower coverage.
    """
    highest = max(mount.coverage for mount in mounts)
    equals = [mount for mount in mounts if mount.coverage == highest]
    return equals[len(equals) // 2]
