"""How well codes tell views apart: sharpness, wrong matches, basin of the search, robustness."""

from __future__ import annotations

import math

import numpy as np

from encoder_sections.images import Codes
from vsearch_jax.env import FALSE_POSITIVE_DEG

_FAR_DEG = 150.0
"""From here on a start is on the far side of the target, in degrees of azimuth."""


def measure(codes: Codes, band_deg: float, symmetry: int, threshold: float) -> dict[str, float]:
    """Measures one encoder.

    Args:
      codes: codes of clean and of disturbed views.
      band_deg: height of the band in degrees.
      symmetry: number of turns about the vertical that map the object to itself; 0 for any.
      threshold: cosine at which a view counts as found.

    Returns:
      Measures by name; the names hold the units.
    """
    shape = (codes.grid.shape[0], codes.grid.shape[1])
    grid = _unit(np.asarray(codes.grid).reshape(-1, codes.grid.shape[-1]))
    rotations = np.asarray(codes.grid_camera.rotation).reshape(-1, 3, 3)
    cosines, angles = grid @ grid.T, _angles_deg(rotations, rotations, symmetry)
    np.fill_diagonal(cosines, -1.0)
    is_match, is_far = cosines >= threshold, angles > FALSE_POSITIVE_DEG
    azimuth, elevation = (_axis_angle(cosines.reshape(*shape, *shape), axis, angles, threshold) for axis in (0, 1))
    rings = {f"cosine_at_{degrees}_deg": _ring(cosines, angles, degrees) for degrees in (3, 5, 10, 90)}
    return {
        "false_match_rate": float((is_match & is_far).sum() / max(is_match.sum(), 1)),
        "targets_with_false_match_rate": float((is_match & is_far).any(axis=1).mean()),
        "match_angle_deg_median": _median(angles[is_match]),
        "threshold_angle_deg_azimuth": azimuth,
        "threshold_angle_deg_elevation": elevation,
        "far_cosine_max_mean": float(np.where(angles > 20.0, cosines, -1.0).max(axis=1).mean()),
        **_basin(cosines, angles, shape),
        **rings,
        **_robustness(codes, band_deg, symmetry),
    }


def _unit(codes: np.ndarray) -> np.ndarray:
    return codes / np.maximum(np.linalg.norm(codes, axis=-1, keepdims=True), 1e-12)


def _angles_deg(first: np.ndarray, second: np.ndarray, symmetry: int) -> np.ndarray:
    """Returns the rotation errors f64[N, M] in degrees between N and M cameras, to the nearest symmetric pose."""
    turns = np.linspace(0.0, 2.0 * math.pi, symmetry if symmetry > 0 else 360, endpoint=False)
    best = np.full((len(first), len(second)), -1.0)
    for turn in turns:
        cos, sin = math.cos(turn), math.sin(turn)
        turned = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]]) @ second
        traces = np.einsum("nij,mij->nm", first, turned)
        best = np.maximum(best, 0.5 * (traces - 1.0))
    return np.degrees(np.arccos(np.clip(best, -1.0, 1.0)))


def _axis_angle(cosines: np.ndarray, axis: int, angles: np.ndarray, threshold: float) -> float:
    """Returns the angle in degrees at which the cosine of neighbours along one axis of the grid meets the threshold."""
    count_azimuths, count_elevations = cosines.shape[:2]
    angles = angles.reshape(cosines.shape)
    pairs = []
    for i in range(count_azimuths):
        for j in range(count_elevations):
            k, m = ((i + 1) % count_azimuths, j) if axis == 0 else (i, j + 1)
            if m < count_elevations:
                pairs.append((1.0 - cosines[i, j, k, m], angles[i, j, k, m] ** 2))
    loss, square = np.sum(pairs, axis=0)
    return float(math.sqrt((1.0 - threshold) * square / loss))


def _ring(cosines: np.ndarray, angles: np.ndarray, degrees: float) -> float:
    """Returns the mean cosine of pairs that are some angle apart, within a tenth of it, or NaN without a pair."""
    return _mean(cosines[np.abs(angles - degrees) < 0.1 * degrees])


def _mean(values: np.ndarray) -> float:
    return float(values.mean()) if values.size else math.nan


def _median(values: np.ndarray) -> float:
    return float(np.median(values)) if values.size else math.nan


def _basin(cosines: np.ndarray, angles: np.ndarray, shape: tuple[int, int]) -> dict[str, float]:
    """Returns the share of the pairs (start, target) from which climbing the cosine over the grid leads to the target.

    A step goes to the best of the eight neighbours. The target is reached at a distance of one neighbour, or at a
    distance of as many degrees from a pose from which the object looks the same. `basin_share_far` is of the starts
    whose azimuth is 150 degrees or more from the target's.
    """
    numbers = np.arange(cosines.shape[0]).reshape(shape)
    rows, columns = np.indices(shape)
    neighbours = np.stack(
        [
            numbers[(rows + i) % shape[0], np.clip(columns + j, 0, shape[1] - 1)].ravel()
            for i in (-1, 0, 1)
            for j in (-1, 0, 1)
        ]
    )
    np.fill_diagonal(cosines, 1.0)
    best = neighbours[np.argmax(cosines[neighbours], axis=0), np.arange(cosines.shape[0])[:, None]]
    position = np.broadcast_to(np.arange(cosines.shape[0])[:, None], cosines.shape)
    for _ in range(sum(shape)):
        position = np.take_along_axis(best, position, axis=0)
    np.fill_diagonal(cosines, -1.0)
    targets = np.arange(cosines.shape[0])
    is_found = (neighbours[:, targets][None] == position[:, None]).any(axis=1)
    is_found |= angles[position, targets[None]] <= 360.0 / shape[0]
    azimuths = np.repeat(np.arange(shape[0]), shape[1]) * 360.0 / shape[0]
    apart = np.abs((azimuths[:, None] - azimuths[None] + 180.0) % 360.0 - 180.0)
    return {"basin_share": float(is_found.mean()), "basin_share_far": _mean(is_found[apart >= _FAR_DEG])}


def _robustness(codes: Codes, band_deg: float, symmetry: int) -> dict[str, float]:
    """Returns for each disturbance how much it changes the cosine, and how far it moves the best match."""
    measured: dict[str, float] = {}
    grid = _unit(np.asarray(codes.grid))
    clean = _unit(np.asarray(codes.disturbed["none"])[:, 0])  # its images are equal
    period = 360.0 / symmetry if symmetry > 0 else 1e-6
    for name, disturbed in codes.disturbed.items():
        if name == "none":
            continue
        unit = _unit(np.asarray(disturbed))
        cosine = np.einsum("vdz,vz->vd", unit, clean)
        offset = _best_match(grid, unit, band_deg) - _best_match(grid, clean, band_deg)[:, None]
        offset[..., 0] = (offset[..., 0] + 0.5 * period) % period - 0.5 * period
        measured[f"{name}_cosine_change_percent"] = float(100.0 * (1.0 - cosine).mean())
        measured[f"{name}_cosine_change_percent_p95"] = float(100.0 * np.percentile(1.0 - cosine, 95))
        measured[f"{name}_pose_change_deg"] = float(np.linalg.norm(offset, axis=-1).mean())
    return measured


def _best_match(grid: np.ndarray, codes: np.ndarray, band_deg: float) -> np.ndarray:
    """Returns azimuth and elevation in degrees at which the cosine is highest, f64[..., 2], between the grid's points.

    The place between the points is the top of a parabola through the best point and its two neighbours on each axis.

    Args:
      grid: f64[A, E, Z], unit codes of the grid.
      codes: f64[..., Z], unit codes.
      band_deg: height of the band in degrees.
    """
    num_azimuths, num_elevations = grid.shape[:2]
    flat = codes.reshape(-1, codes.shape[-1])
    cosines = np.einsum("nz,aez->nae", flat, grid)
    best = np.argmax(cosines.reshape(len(flat), -1), axis=1)
    row, column = best // num_elevations, best % num_elevations
    inner = np.clip(column, 1, max(num_elevations - 2, 1))
    index = np.arange(len(flat))
    along = [cosines[index, (row + step) % num_azimuths, column] for step in (-1, 0, 1)]
    across = [cosines[index, row, np.clip(inner + step, 0, num_elevations - 1)] for step in (-1, 0, 1)]
    azimuth = (row + _top(along)) * 360.0 / num_azimuths
    elevation = np.clip(inner + _top(across), 0.0, num_elevations - 1.0) * band_deg / (num_elevations - 1)
    return np.stack([azimuth, elevation], axis=-1).reshape(*codes.shape[:-1], 2)


def _top(values: list[np.ndarray]) -> np.ndarray:
    """Returns where the parabola through three values at -1, 0 and 1 is highest, at most 1 away from 0."""
    curvature = values[0] - 2.0 * values[1] + values[2]
    safe = np.where(curvature < -1e-9, curvature, -1.0)
    return np.clip(np.where(curvature < -1e-9, 0.5 * (values[0] - values[2]) / safe, 0.0), -1.0, 1.0)
