import importlib.metadata
from pathlib import Path

import jax
import numpy as np
import pytest

from oracles.render import cast_image
from vsearch_jax.cli import info, selftest
from vsearch_jax.cli.main import main

find_difference = selftest.find_difference


def values(output: str) -> dict[str, str]:
    """Returns the printed lines as {label: value}."""
    return {label: value.strip() for label, _, value in (line.partition(":") for line in output.splitlines())}


def test_info_prints_versions_devices_folders_and_the_self_test(capsys: pytest.CaptureFixture[str]) -> None:
    main(["info"])
    printed = values(capsys.readouterr().out)
    for package in ("vsearch_jax", "jax", "jaxlib", "mujoco", "mujoco-mjx", "flax", "optax", "brax", "evosax", "numpy"):
        assert printed[package] == importlib.metadata.version(package)
    assert printed["orbax-checkpoint"] == importlib.metadata.version("orbax-checkpoint")
    assert printed["Python"].startswith("3.") and printed["platform"]
    assert jax.devices()[0].device_kind in printed["devices"]
    assert printed["compilation cache"] == (jax.config.jax_compilation_cache_dir or "off")
    assert (Path(printed["package folder"]) / "cli" / "info.py").is_file()
    assert (Path(printed["xml folder"]) / "scene.xml").is_file()
    assert printed["extra video"].startswith(("installed", "not installed"))
    assert printed["renderer self-test"] == "ok"


def test_a_wrong_reference_fails_with_status_1(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    with np.load(selftest.REFERENCE) as stored:
        rgb, geom_id = stored["rgb"], stored["geom_id"]
    wrong = tmp_path / "wrong.npz"
    np.savez(wrong, rgb=rgb, geom_id=np.roll(geom_id, 3, axis=1))
    monkeypatch.setattr(selftest, "find_difference", lambda: find_difference(wrong))
    with pytest.raises(SystemExit) as exit_:
        main(["info"])
    assert exit_.value.code == 1
    assert "pixels show another geom" in values(capsys.readouterr().out)["renderer self-test"]


def test_a_wrong_colour_is_a_difference(tmp_path: Path) -> None:
    with np.load(selftest.REFERENCE) as stored:
        rgb, geom_id = stored["rgb"], stored["geom_id"]
    wrong = tmp_path / "wrong.npz"
    np.savez(wrong, rgb=255 - rgb, geom_id=geom_id)
    difference = find_difference(wrong)
    assert difference is not None and "0 of 1024 pixels show another geom" in difference


def test_an_exception_in_the_self_test_is_reported(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail() -> str | None:
        raise RuntimeError("no memory\nleft")

    monkeypatch.setattr(selftest, "find_difference", fail)
    assert not info.print_info()
    assert values(capsys.readouterr().out)["renderer self-test"] == "RuntimeError: no memory left"


def test_missing_devices_are_reported_and_the_other_lines_stay(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail() -> list[jax.Device]:
        raise AssertionError

    monkeypatch.setattr(jax, "devices", fail)
    monkeypatch.setattr(selftest, "find_difference", lambda: None)
    assert info.print_info()
    printed = values(capsys.readouterr().out)
    assert printed["devices"].startswith("none (AssertionError") and printed["jax"] == jax.__version__


def test_make_reference_gives_the_stored_reference(tmp_path: Path) -> None:
    selftest.make_reference(tmp_path / "new.npz")
    assert find_difference(tmp_path / "new.npz") is None
    with np.load(tmp_path / "new.npz") as new, np.load(selftest.REFERENCE) as stored:
        assert new["rgb"].shape == stored["rgb"].shape == (*selftest.SIZE, 3)
        assert new["geom_id"].dtype == stored["geom_id"].dtype


def test_the_reference_shows_every_geom_where_mujocos_rays_hit_it() -> None:
    model, data = selftest.load_scene()
    _, ids = cast_image(model, data, 0, selftest.SIZE)
    with np.load(selftest.REFERENCE) as stored:
        geom_id = stored["geom_id"]
    assert set(np.unique(geom_id)) == {-1, *range(model.ngeom)}
    assert (geom_id != ids).sum() <= 2  # rays that touch an edge
