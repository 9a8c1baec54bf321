"""The command `reach`: bands between the rows of the map, exact heights, and the refusals of `train`."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

import vsearch_jax as vs
from samples import made_up
from vsearch_jax import render
from vsearch_jax.cli import reach
from vsearch_jax.config import IKConfig, SceneConfig
from vsearch_jax.planning import mount_scan
from vsearch_jax.render import RenderError


def test_the_ends_of_a_band_between_two_rows_are_views_of_their_own() -> None:
    config = IKConfig(map_elevations=19)  # a row every 5 degrees
    assert mount_scan.ends_between_rows(config, (40.0, 70.0)) == []
    assert mount_scan.ends_between_rows(config, (41.0, 44.0)) == [41.0, 44.0]
    assert mount_scan.ends_between_rows(config, (40.0, 44.0)) == [44.0]
    assert mount_scan.ends_between_rows(config, (42.0, 42.0)) == [42.0]


def test_coverage_counts_the_rows_in_the_band_and_its_ends() -> None:
    reachable = made_up.reach()  # rows every 15 degrees, reachable from 45 to 60
    none, all_, half = np.zeros((12, 0), bool), np.ones((12, 1), bool), np.arange(12)[:, None] < 6
    assert mount_scan.coverage(reachable, (45.0, 75.0), none) == pytest.approx(2 / 3)
    assert mount_scan.coverage(reachable, (46.0, 47.0), np.concatenate([all_, half], axis=1)) == pytest.approx(3 / 4)
    assert mount_scan.coverage(reachable, (45.0, 50.0), half) == pytest.approx(3 / 4)


def test_the_ends_of_a_band_are_solved_at_every_azimuth(monkeypatch: pytest.MonkeyPatch) -> None:
    def solve(arm, reach, view, qpos, sphere, config):
        return None, (view.azimuth < 3.0) & (view.elevation > 0.72)

    monkeypatch.setattr(mount_scan, "solve_view", solve)
    reachable, ends = made_up.reach(), jnp.deg2rad(jnp.array([41.0, 44.0]))
    arm: Any = SimpleNamespace(home=jnp.zeros(9))
    sphere = (jnp.zeros(3), jnp.float32(0.35))
    found = mount_scan._are_rows_reachable(arm, reachable, ends, sphere, IKConfig())
    expected = np.stack([np.zeros(12, bool), np.arange(12) < 6], axis=1)
    np.testing.assert_array_equal(found, expected)
    assert mount_scan._are_rows_reachable(arm, reachable, ends[:0], sphere, IKConfig()).shape == (12, 0)


def test_heights_are_printed_as_they_were_given_and_pictures_are_atomic(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    tried: list[float] = []

    def scan(config, heights, band_deg):
        tried.extend(heights)
        return [mount_scan.Mount(height, made_up.reach(), float(height == 1.355)) for height in heights]

    monkeypatch.setattr(reach, "build_parts", lambda config: None)
    monkeypatch.setattr(reach, "scan_mounts", scan)
    message = reach.draw_reach(tmp_path, SceneConfig(), (40.0, 70.0), (1.35, 1.36, 0.005))
    assert message.startswith("mount height 1.355 m:") and tried == [1.35, 1.355, 1.36]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["mount_heights.png", "reachability.png"]

    def fail(descriptor: int) -> None:
        raise OSError("no space")

    monkeypatch.setattr("os.fsync", fail)
    before = (tmp_path / "reachability.png").read_bytes()
    with pytest.raises(OSError, match="no space"):
        reach.draw_reach(tmp_path, SceneConfig(), (41.0, 44.0), (1.35, 1.36, 0.005))
    assert (tmp_path / "reachability.png").read_bytes() == before and len(list(tmp_path.iterdir())) == 2


def test_reach_and_train_refuse_a_scene_that_the_renderer_cannot_draw(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def refuse(model):
        raise RenderError("light 'sun' cannot be drawn")

    monkeypatch.setattr(render, "compile_scene", refuse)
    with pytest.raises(RenderError, match="light 'sun'"):
        reach.draw_reach(tmp_path, SceneConfig(), (40.0, 70.0), (1.35, 1.36, 0.005))
    with pytest.raises(RenderError, match="light 'sun'"):
        vs.ViewSearchEnv(vs.Config.preset("smoke"))
    assert not any(tmp_path.iterdir())
