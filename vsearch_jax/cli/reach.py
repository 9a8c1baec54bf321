"""Draws what an arm reaches, and proposes a mount height."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import numpy as np

from vsearch_jax import report
from vsearch_jax.config import Config, ConfigError, SceneConfig
from vsearch_jax.env import build_parts
from vsearch_jax.planning.mount_scan import Mount, best_mount, scan_mounts
from vsearch_jax.robot.blocking import describe_blocking_contacts
from vsearch_jax.runs.atomic import write_atomically
from vsearch_jax.scene import build_scene

NUM_AZIMUTHS = 24
"""Azimuths of a reachability map. Between them, what an arm reaches changes little."""
MAX_HEIGHTS = 200
"""Largest number of mount heights."""


def draw_reach(
    out: Path, scene: SceneConfig, band_deg: tuple[float, float], heights: tuple[float, float, float]
) -> str:
    """Finds the mount height from which the arm reaches most views of a band of elevations, and draws two figures.

    One figure shows the views that the arm reaches at the best height. The other shows the coverage at every height:
    the share of the band's views that the arm reaches.

    Args:
      out: folder of the figures, `reachability.png` and `mount_heights.png`.
      scene: arm, object and view sphere. The mount height in it is not used.
      band_deg: lowest and highest elevation to cover, in degrees.
      heights: lowest and highest mount height to try, and the step between heights, in m.

    Returns:
      One line that describes the best mount height.

    Raises:
      ConfigError: `heights` or `band_deg` is no range, or no height reaches a view of the band. In the last case the
        figures are drawn.
      SceneError, RenderError: the scene cannot be built, drawn or planned in; see `env.build_parts`.
      OSError: the disk is full or not writable.
    """
    _check_ranges(band_deg, heights)
    low, high, step = heights
    ik = dataclasses.replace(Config().ik, map_azimuths=NUM_AZIMUTHS)
    config = dataclasses.replace(Config(), scene=scene, ik=ik)
    build_parts(config)  # refuses what `train` refuses
    # Rounded: a sum of steps such as 0.8 + 11 * 0.05 is 1.35 plus a rounding error.
    tried = np.round(np.arange(int((high - low) / step + 1e-6) + 1) * step + low, 9)
    mounts = scan_mounts(config, tried.tolist(), band_deg)
    best = best_mount(mounts)
    coverages = [mount.coverage for mount in mounts]
    figures = {
        "reachability.png": report.draw_reachability(best.reach, band_deg),
        "mount_heights.png": report.draw_mount_heights([mount.height for mount in mounts], coverages, best.height),
    }
    for name, figure in figures.items():
        write_atomically(out / name, report.to_png(figure))
    views = f"views from {band_deg[0]:g} to {band_deg[1]:g} degrees of elevation"
    if best.coverage == 0.0:
        blocking = describe_blocking_contacts(build_scene(dataclasses.replace(scene, mount_height=best.height)))
        raise ConfigError(
            f"arm {scene.arm!r} reaches none of the {views} around object {scene.object!r} at any mount height from "
            f"{low:.10g} to {high:.10g} m; {out / 'reachability.png'} shows what it reaches{blocking}"
        )
    is_at_end = best.coverage < 1.0 and len(mounts) > 1 and best.height in (mounts[0].height, mounts[-1].height)
    return _describe(best, views, is_at_end, out)


def _check_ranges(band_deg: tuple[float, float], heights: tuple[float, float, float]) -> None:
    low, high, step = heights
    if not (0.0 < low <= high < math.inf and high - low < MAX_HEIGHTS * step < math.inf):
        allowed = f"lowest, highest and step in m, above 0, {MAX_HEIGHTS} heights at most"
        raise ConfigError(f"--heights is {low:g} {high:g} {step:g}; allowed: {allowed}")
    if not 0.0 <= band_deg[0] <= band_deg[1] <= 90.0:
        allowed = "lowest and highest elevation, from 0 to 90 degrees"
        raise ConfigError(f"--band is {band_deg[0]:g} {band_deg[1]:g}; allowed: {allowed}")


def _describe(best: Mount, views: str, is_at_end: bool, out: Path) -> str:
    """Returns one line about the best mount height.

    Args:
      best: the best mount height.
      views: description of the views to cover.
      is_at_end: whether it is the lowest or highest height tried. The coverage may then rise further beyond.
      out: folder of the figures.
    """
    band = np.rad2deg(np.asarray(best.reach.band))
    elevations = "no elevation" if np.isnan(band).any() else f"elevations from {band[0]:.0f} to {band[1]:.0f} degrees"
    beyond = ", at the end of the heights tried: a wider range may give a better one" if is_at_end else ""
    return (
        f"mount height {best.height:.10g} m{beyond}: the arm reaches {100 * best.coverage:.1f} % of the {views}, and "
        f"{elevations} at every azimuth, which is the band that `vsearch train` searches; see "
        f"{out / 'reachability.png'}"
    )
