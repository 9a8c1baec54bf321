"""What holds for the tree as a whole: public names, pins, linters in `make test`, the wheel, the version."""

import importlib.metadata
import os
import subprocess
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest

import vsearch_jax

ROOT = Path(__file__).resolve().parent.parent


def test_every_public_name_is_there() -> None:
    for name in vsearch_jax.__all__:
        assert getattr(vsearch_jax, name) is not None
    assert set(vsearch_jax.__all__) <= set(dir(vsearch_jax))
    with pytest.raises(AttributeError, match="no attribute 'bogus'"):
        _ = vsearch_jax.bogus


def test_every_pin_is_exact_and_names_no_registry() -> None:
    for name in ("constraints.txt", "constraints-newest.txt"):
        pins = [line for line in (ROOT / name).read_text().splitlines() if not line.startswith("#")]
        assert len(pins) > 50
        for pin in pins:
            assert "==" in pin and "/" not in pin and "@" not in pin, pin


def test_make_test_calls_every_hook_of_pre_commit() -> None:
    hooks = [
        line.split(":", 1)[1].strip()
        for line in (ROOT / ".pre-commit-config.yaml").read_text().splitlines()
        if "entry:" in line
    ]
    makefile = (ROOT / "Makefile").read_text()
    assert hooks
    for hook in hooks:
        assert hook.replace(".venv", "$(VENV)") in makefile


def check_files_of_the_wheel(site: Path) -> None:
    """Checks the files of an installed wheel that are not Python, and its console script."""
    package = site / "vsearch_jax"
    assert (package / "py.typed").is_file()
    assert "<html" in (package / "report" / "page.html").read_text(encoding="utf-8")
    with np.load(package / "cli" / "selftest.npz") as stored:
        assert stored.files and all(stored[name].size for name in stored.files)
    (distribution,) = importlib.metadata.distributions(name="vsearch_jax", path=[str(site)])
    assert [(script.name, script.value) for script in distribution.entry_points] == [
        ("vsearch", "vsearch_jax.cli.main:main")
    ]


def test_the_wheel_works_outside_the_checkout(tmp_path: Path) -> None:
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "--quiet"]
    wheel = ["wheel", "--no-deps", "--no-build-isolation", "--wheel-dir", str(tmp_path / "wheel"), str(ROOT)]
    subprocess.run([*pip, *wheel], check=True)
    (built,) = (tmp_path / "wheel").glob("*.whl")
    site = tmp_path / "site"
    subprocess.run([*pip, "install", "--no-deps", "--no-index", "--target", str(site), str(built)], check=True)
    check_files_of_the_wheel(site)
    code = (
        "import vsearch_jax; from vsearch_jax.config import SceneConfig; from vsearch_jax.scene import build_scene;"
        "print(vsearch_jax.__file__, build_scene(SceneConfig()).mj_model.nq)"
    )
    environment = os.environ | {"PYTHONPATH": str(site)}
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, env=environment, check=True, capture_output=True, text=True
    )
    assert done.stdout.splitlines()[-1] == f"{site / 'vsearch_jax' / '__init__.py'} 9"


def test_version_is_that_of_the_project_file() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert importlib.metadata.version("vsearch_jax") == project["version"]
