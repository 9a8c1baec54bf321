"""`eval/thesis.py` writes every table and figure, and continues where it was stopped."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
FIGURES = {"3_1", *(f"5_{number}" for number in range(1, 14))}


def run_script(out: Path) -> None:
    command = [sys.executable, str(ROOT / "eval" / "thesis.py"), "--quick", "--out", str(out)]
    done = subprocess.run(command, capture_output=True, text=True, env=os.environ | {"JAX_PLATFORMS": "cpu"})
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]


@pytest.mark.slow
def test_every_table_and_figure_is_written_and_a_second_command_keeps_what_is_done(tmp_path: Path) -> None:
    run_script(tmp_path)
    assert {path.stem.removeprefix("figure_") for path in (tmp_path / "figures").iterdir()} == FIGURES
    page = (tmp_path / "thesis.md").read_text(encoding="utf-8")
    for picture in re.findall(r"!\[.*\]\((.*)\)", page):
        assert (tmp_path / picture).is_file()
    content = json.loads((tmp_path / "thesis.json").read_text(encoding="utf-8"))
    assert [row["k"] for row in content["table_5_1"]] == [0.5, 1.5, 2.5, 4.5]
    assert [round(row["initial_rotation_error_deg"]) for row in content["table_5_2"]] == [130, 140, 170]
    for row in content["table_5_2"]:
        assert row["penalty"]["unreachable_first_generation_mean"] > 0.0
        assert row["bounds"]["unreachable_first_generation_mean"] == 0.0
    assert {row["searcher"] for row in content["searchers"]} >= {"Random search", "CMA-ES", "SAC policy alone"}

    (tmp_path / "arrays" / "penalty.npz").unlink()
    times = {path.name: path.stat().st_mtime_ns for path in (tmp_path / "arrays").iterdir()}
    run_script(tmp_path)
    assert {path.name for path in (tmp_path / "arrays").iterdir()} == {*times, "penalty.npz"}
    assert {name: (tmp_path / "arrays" / name).stat().st_mtime_ns for name in times} == times
    assert json.loads((tmp_path / "thesis.json").read_text(encoding="utf-8")) == content
