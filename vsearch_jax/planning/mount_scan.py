"""At which height an arm is to be hung, so that it reaches the views that are wanted."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from vsearch_jax.config import Config
from vsearch_jax.planning import reachability_map
from vsearch_jax.robot.arm import build_arm
from vsearch_jax.scene import build_scene
from vsearch_jax.types import ReachabilityMap


class Mount(NamedTuple):
    """A mount height in m, what the arm reaches from there, and the share of the wanted views in that, in [0, 1]."""

    height: float
    reach: ReachabilityMap
    coverage: float


def scan_mounts(config: Config, heights: Sequence[float], band_deg: tuple[float, float], seed: int = 0) -> list[Mount]:
    """Returns what the arm of `config` reaches from each of the `heights`.

    Args:
      config: arm, object and view sphere; sizes of the map.
      heights: m above the table, of the arm's base.
      band_deg: lowest and highest elevation wanted, in degrees.
      seed: of the map's random starts.

    Raises:
      SceneError: arm or object can't be loaded.
    """

    @jax.jit
    def solve(arm, center, radius, key):
        return reachability_map(arm, center, radius, config.ik, key)

    mounts = []
    for height in heights:
        scene = build_scene(dataclasses.replace(config.scene, mount_height=height))
        # Which pairs planning looks at depends on the height; without them one compilation serves all heights.
        arm = dataclasses.replace(build_arm(scene), planning_pairs=None)
        center = jnp.asarray(scene.center, jnp.float32)
        reach = solve(arm, center, jnp.float32(scene.radius), jax.random.key(seed))
        mounts.append(Mount(height, reach, coverage(reach, band_deg)))
    return mounts


def coverage(reach: ReachabilityMap, band_deg: tuple[float, float]) -> float:
    """Returns the share of the map's cells between two elevations (degrees, ends included) that are reachable."""
    elevations = np.rad2deg(np.asarray(reach.elevations))
    is_wanted = (elevations >= band_deg[0] - 1e-3) & (elevations <= band_deg[1] + 1e-3)
    return float(np.asarray(reach.is_reachable)[:, is_wanted].mean()) if is_wanted.any() else 0.0


def best_mount(mounts: Sequence[Mount]) -> Mount:
    """Returns the mount with the highest coverage; of equals the one in their middle, farthest from where it falls."""
    highest = max(mount.coverage for mount in mounts)
    equals = [mount for mount in mounts if mount.coverage == highest]
    return equals[len(equals) // 2]
