"""`eval/encoders.py` measures codes whose cosines are known functions of the views, and runs whole in small."""

from __future__ import annotations

import json
import math
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from vsearch_jax.types import Camera

ROOT = Path(__file__).resolve().parent.parent
AZIMUTHS, ELEVATIONS, BAND_DEG = 36, 7, 60.0


@pytest.fixture
def sections(monkeypatch: pytest.MonkeyPatch) -> tuple[ModuleType, ModuleType]:
    monkeypatch.syspath_prepend(str(ROOT / "eval"))
    from encoder_sections import images, measures  # eval/ is no package: it is on the path only here

    return images, measures


def codes_of(views_deg: np.ndarray, turns: int) -> np.ndarray:
    """Returns codes f64[..., 4] whose cosine is (cos(turns * azimuth difference) + cos(elevation difference)) / 2."""
    azimuth, elevation = turns * np.deg2rad(views_deg[..., 0]), np.deg2rad(views_deg[..., 1])
    parts = (np.cos(azimuth), np.sin(azimuth), np.cos(elevation), np.sin(elevation))
    return np.stack(parts, axis=-1) / math.sqrt(2.0)


def make_codes(images: ModuleType, turns: int, shift_deg: float):
    """Returns codes of a grid; two views of it are disturbed so that they seem moved by `shift_deg` of azimuth."""
    azimuths = np.arange(AZIMUTHS) * 360.0 / AZIMUTHS - 180.0
    grid = np.stack(np.meshgrid(azimuths, np.linspace(20.0, 20.0 + BAND_DEG, ELEVATIONS), indexing="ij"), axis=-1)
    rotations = Rotation.from_euler("ZY", grid.reshape(-1, 2), degrees=True).as_matrix()
    turns_of_grid = jnp.asarray(rotations.reshape(AZIMUTHS, ELEVATIONS, 3, 3))
    cameras = Camera(jnp.zeros(3), turns_of_grid, jnp.zeros(()))
    views = np.array([[13.0, 41.0], [-176.0, 58.0]])[:, None].repeat(3, axis=1)
    moved = views + np.array([shift_deg, 0.0])
    disturbed = {name: codes_of(views if name == "none" else moved, turns) for name in images.DISTURBANCES}
    return images.Codes(codes_of(grid, turns), cameras, disturbed)


def test_an_unambiguous_code_has_its_known_sharpness_and_no_wrong_match(sections) -> None:
    images, measures = sections
    found = measures.measure(make_codes(images, 1, 4.0), BAND_DEG, 1, 0.98)
    wanted = math.degrees(math.acos(2 * 0.98 - 1))  # along one axis, where the other difference is 0
    assert found["threshold_angle_deg_azimuth"] == pytest.approx(wanted, rel=0.03)
    assert found["threshold_angle_deg_elevation"] == pytest.approx(wanted, rel=0.03)
    assert found["basin_share"] == 1.0
    assert found["cosine_at_10_deg"] == pytest.approx(0.5 * (1.0 + math.cos(math.radians(10.0))), abs=2e-3)
    # A shift by 4 degrees is seen between the points of a grid of 10 degrees.
    assert found["light_pose_change_deg"] == pytest.approx(4.0, abs=0.2)
    assert found["light_cosine_change_percent"] == pytest.approx(50.0 * (1.0 - math.cos(math.radians(4.0))), rel=1e-3)


def test_a_code_that_repeats_after_half_a_turn_matches_wrong_views(sections) -> None:
    images, measures = sections
    codes = make_codes(images, 2, 0.0)
    found = measures.measure(codes, BAND_DEG, 1, 0.995)  # neighbours of the grid do not meet this threshold
    assert found["targets_with_false_match_rate"] == found["false_match_rate"] == 1.0
    assert found["far_cosine_max_mean"] == pytest.approx(1.0, abs=1e-6)
    assert 0.4 < found["basin_share"] < 0.7
    # For an object that looks the same after half a turn, these views are right.
    assert measures.measure(codes, BAND_DEG, 2, 0.995)["targets_with_false_match_rate"] == 0.0


@pytest.mark.slow
def test_the_script_measures_every_encoder_and_keeps_what_is_done(tmp_path: Path) -> None:
    command = [sys.executable, str(ROOT / "eval" / "encoders.py"), "--quick", "--out", str(tmp_path)]
    command += ["--objects", "teapot", "part:plate", "--losses", "pose", "--seeds", "1"]
    times = []
    for _ in range(2):
        done = subprocess.run(command, capture_output=True, text=True)
        assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]
        times.append({path.name: path.stat().st_mtime_ns for path in (tmp_path / "rows").iterdir()})
    assert times[0] == times[1]
    rows = json.loads((tmp_path / "encoders.json").read_text(encoding="utf-8"))["rows"]
    assert [row["object"] for row in rows] == ["part:plate", "teapot"]
    assert all(0.0 <= row["basin_share"] <= 1.0 for row in rows)
    assert "| teapot | pose | 1 |" in (tmp_path / "encoders.md").read_text(encoding="utf-8")
