"""Finds the mount height from which an arm reaches most of the wanted views."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from vsearch_jax.config import Config
from vsearch_jax.planning.reachability import reachability_map
from vsearch_jax.robot.arm import Arm, build_arm
from vsearch_jax.scene import build_scene
from vsearch_jax.types import ReachabilityMap


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

    @jax.jit
    def solve(arm: Arm, center: Array, radius: Array, key: Array) -> ReachabilityMap:
        return reachability_map(arm, center, radius, config.ik, key)

    mounts = []
    for height in heights:
        scene = build_scene(dataclasses.replace(config.scene, mount_height=height))
        # The number of planning pairs depends on the height. Without them one compilation serves all heights.
        arm = dataclasses.replace(build_arm(scene), planning_pairs=None)
        center = jnp.asarray(scene.center, jnp.float32)
        reach = solve(arm, center, jnp.float32(scene.radius), jax.random.key(seed))
        mounts.append(Mount(height, reach, coverage(reach, band_deg)))
    return mounts


def coverage(reach: ReachabilityMap, band_deg: tuple[float, float]) -> float:
    """Returns the share in [0, 1] of the wanted views that the arm reaches; 0 if the map has no view in the band.

    The wanted views are the views of the map's grid in a band, that is, between two elevations.

    Args:
      reach: reachability map of the arm.
      band_deg: lowest and highest elevation in degrees, both included.
    """
    elevations = np.rad2deg(np.asarray(reach.elevations))
    is_wanted = (elevations >= band_deg[0] - 1e-3) & (elevations <= band_deg[1] + 1e-3)
    return float(np.asarray(reach.is_reachable)[:, is_wanted].mean()) if is_wanted.any() else 0.0


def best_mount(mounts: Sequence[Mount]) -> Mount:
    """Returns the mount height with the highest coverage.

    If several heights are equal, it is the middle one of them. That one is farthest from heights with lower coverage.
    """
    highest = max(mount.coverage for mount in mounts)
    equals = [mount for mount in mounts if mount.coverage == highest]
    return equals[len(equals) // 2]
