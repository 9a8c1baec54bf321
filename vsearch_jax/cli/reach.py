"""What an arm reaches, in pictures, and where to hang it."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import numpy as np

from vsearch_jax import report
from vsearch_jax.config import Config, ConfigError, SceneConfig
from vsearch_jax.planning.mount_scan import best_mount, scan_mounts

# Azimuths of the maps: what an arm reaches changes little between.
NUM_AZIMUTHS = 24
MOST_HEIGHTS = 200


def draw_reach(
    out: Path, scene: SceneConfig, band_deg: tuple[float, float], heights: tuple[float, float, float]
) -> str:
    """Draws the reachability map at the best mount height and the coverage of each, and returns a line to tell.

    Args:
      out: folder of `reachability.png` and `mount_heights.png`.
      scene: arm, object and view sphere; its mount height is not used.
      band_deg: lowest and highest elevation wanted, in degrees.
      heights: lowest and highest mount height to try and the step between, in m.

    Raises:
      ConfigError: heights or band are no range, or a wanted view is in reach from no height; the map is drawn then too.
      SceneError: arm or object can't be loaded.
    """
    low, high, step = heights
    if not (0.0 < low <= high < math.inf and high - low < MOST_HEIGHTS * step < math.inf):
        allowed = f"lowest, highest and step in m, above 0, {MOST_HEIGHTS} heights at most"
        raise ConfigError(f"heights are {low:g} {high:g} {step:g}; allowed: {allowed}")
    if not 0.0 <= band_deg[0] <= band_deg[1] <= 90.0:
        raise ConfigError(f"band is {band_deg[0]:g} {band_deg[1]:g}; allowed: lowest and highest, from 0 to 90 degrees")
    ik = dataclasses.replace(Config().ik, map_azimuths=NUM_AZIMUTHS)
    tried = np.arange(int((high - low) / step + 1e-6) + 1) * step + low
    mounts = scan_mounts(dataclasses.replace(Config(), scene=scene, ik=ik), tried.tolist(), band_deg)
    best = best_mount(mounts)
    report.reachability(best.reach, band_deg).savefig(out / "reachability.png")
    curve = report.mount_heights([mount.height for mount in mounts], [mount.coverage for mount in mounts], best.height)
    curve.savefig(out / "mount_heights.png")
    views = f"views from {band_deg[0]:g} to {band_deg[1]:g} degrees of elevation"
    if best.coverage == 0.0:
        raise ConfigError(
            f"arm {scene.arm!r} reaches none of the {views} around object {scene.object!r} from any height from "
            f"{low:g} to {high:g} m; {out / 'reachability.png'} shows what it does reach"
        )
    band = np.rad2deg(np.asarray(best.reach.band))
    everywhere = "no elevation" if np.isnan(band).any() else f"elevations from {band[0]:.0f} to {band[1]:.0f} degrees"
    # A curve that still rises where the heights end says nothing of what is beyond.
    is_cut = best.coverage < 1.0 and len(tried) > 1 and best.height in (mounts[0].height, mounts[-1].height)
    beyond = ", at the end of the heights tried: wider ones may do better" if is_cut else ""
    return (
        f"mount height {best.height:.3g} m{beyond}: {100 * best.coverage:.1f} % of the {views} are in reach, at every "
        f"azimuth {everywhere}, which is the band that `vsearch train` searches; see {out / 'reachability.png'}"
    )
