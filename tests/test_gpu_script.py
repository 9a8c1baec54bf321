"""The script that measures an accelerator runs whole on the CPU, where it must agree with itself."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
SECTIONS = {
    "renderer",
    "parity with the CPU",
    "IK and RRT-Connect",
    "encoder, environment, SAC",
    "train",
    "evaluate",
}


@pytest.mark.slow
def test_quick_run_measures_every_section(tmp_path: Path) -> None:
    command = [sys.executable, str(ROOT / "eval" / "gpu.py"), "--quick", "--out", str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, env=os.environ | {"JAX_PLATFORMS": "cpu"})
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]
    content = json.loads((tmp_path / "gpu.json").read_text())
    assert set(content["sections"]) == SECTIONS
    for name, section in content["sections"].items():
        assert section["rows"] and "error" not in section, name
    assert all(row["holds"] for row in content["sections"]["parity with the CPU"]["rows"])
    rates = [
        row["per_second"] for name in ("renderer", "IK and RRT-Connect") for row in content["sections"][name]["rows"]
    ]
    assert min(rates) > 0.0
    assert "## parity with the CPU" in (tmp_path / "gpu.md").read_text()


@pytest.mark.gpu
def test_the_accelerator_agrees_with_the_cpu(tmp_path: Path) -> None:
    command = [sys.executable, str(ROOT / "eval" / "gpu.py"), "--minutes", "1", "--out", str(tmp_path)]
    environment = {name: value for name, value in os.environ.items() if name != "JAX_PLATFORMS"}
    subprocess.run(command, env=environment, check=False)
    content = json.loads((tmp_path / "gpu.json").read_text())
    assert content["machine"]["backend"] != "cpu"
    assert all(row["holds"] for row in content["sections"]["parity with the CPU"]["rows"])
