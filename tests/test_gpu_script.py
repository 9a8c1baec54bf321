"""`eval/gpu.py` measures every section: on the CPU in its quick form, on a GPU the comparison with the CPU."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
SECTIONS = {"parity", "train", "evaluate", "renderer", "planning", "rates"}


def run_script(out: Path, platform: dict[str, str], *options: str) -> dict:
    command = [sys.executable, str(ROOT / "eval" / "gpu.py"), "--out", str(out), *options]
    environment = {name: value for name, value in os.environ.items() if name != "JAX_PLATFORMS"} | platform
    done = subprocess.run(command, capture_output=True, text=True, env=environment)
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]
    return json.loads((out / "gpu.json").read_text())


@pytest.mark.slow
def test_quick_run_measures_every_section(tmp_path: Path) -> None:
    content = run_script(tmp_path, {"JAX_PLATFORMS": "cpu"}, "--quick")
    assert set(content["sections"]) == SECTIONS
    for name, section in content["sections"].items():
        assert section["rows"], name
    assert len(content["sections"]["parity"]["rows"]) == 11
    # On one platform both processes compute the same.
    assert max(row["difference"] for row in content["sections"]["parity"]["rows"][:3]) == 0.0
    for name in ("renderer", "planning", "rates"):
        assert all(row["per_second"] > 0.0 for row in content["sections"][name]["rows"]), name
    assert any(row.get("is_finished") for row in content["sections"]["train"]["rows"])
    assert "## parity" in (tmp_path / "gpu.md").read_text()


@pytest.mark.gpu
def test_the_accelerator_agrees_with_the_cpu(tmp_path: Path) -> None:
    content = run_script(tmp_path, {}, "--sections", "parity", "--minutes", "5")
    assert content["machine"]["backend"] != "cpu"
    assert content["sections"]["parity"]["rows"]
