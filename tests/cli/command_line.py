"""Helpers of the command-line tests: run `vsearch` in this process or as a program, and read the folder of a run."""

import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import orbax.checkpoint as ocp
import pytest

from vsearch_jax.cli.main import main
from vsearch_jax.runs import checkpoint
from vsearch_jax.runs.metrics_log import read_metrics

TESTS = Path(__file__).resolve().parents[1]
FAST_RUN = ("-m", "samples.fast_run")
"""Arguments of Python that run `vsearch` with the fast run in place of the real one."""


def user_error(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    """Runs a command that must fail with status 2 and one line of message. Returns the line."""
    with pytest.raises(SystemExit) as exit_:
        main(arguments)
    captured = capsys.readouterr()
    assert exit_.value.code == 2
    assert captured.err.startswith("vsearch: error: ") and captured.err.count("\n") == 1, captured.err
    return captured.err


def python(*arguments: str) -> dict[str, Any]:
    """Returns the arguments of `subprocess.run` for a Python program that can import the tests' helper modules.

    XLA prints warnings about the compilation cache and about slow machines, so both are switched off.
    """
    environment = {name: value for name, value in os.environ.items() if name != "JAX_COMPILATION_CACHE_DIR"}
    environment |= {"TF_CPP_MIN_LOG_LEVEL": "3", "PYTHONPATH": str(TESTS)}
    return {"args": [sys.executable, *arguments], "env": environment, "text": True}


def contents(folder: Path) -> dict[str, bytes]:
    """Returns the content of every file below a folder, by its relative path."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def stored_state(run: Path) -> dict[str, np.ndarray]:
    """Returns the arrays of the last checkpoint by name."""
    step = checkpoint.latest_step(run)
    with ocp.CheckpointManager(run / "checkpoints") as manager:
        arguments = ocp.args.Composite(state=ocp.args.StandardRestore())
        return {name: np.asarray(value) for name, value in manager.restore(step, args=arguments)["state"].items()}


def metrics_without_times(run: Path) -> list[dict[str, Any]]:
    """Returns the lines of metrics.jsonl without their wall times."""
    return [{key: value for key, value in line.items() if key != "seconds"} for line in read_metrics(run)]


def assert_equal_runs(run: Path, other: Path) -> None:
    """Checks that two runs have the same metrics and the same last checkpoint, bit for bit."""
    assert metrics_without_times(run) == metrics_without_times(other)
    state, other_state = stored_state(run), stored_state(other)
    assert state.keys() == other_state.keys()
    for name in state:
        np.testing.assert_array_equal(state[name], other_state[name], err_msg=name)


def wait_for_step(run: Path, step: int, process: subprocess.Popen[str]) -> None:
    """Waits until a running process has saved a checkpoint of `step` or later."""
    deadline = time.monotonic() + 300
    while (checkpoint.latest_step(run) or 0) < step:
        assert process.poll() is None and time.monotonic() < deadline
        time.sleep(0.01)


def wait_for_line(start: str, process: subprocess.Popen[str]) -> None:
    """Waits until a running process prints a line that starts with `start`."""
    assert process.stdout is not None
    while not (line := process.stdout.readline()).startswith(start):
        assert line, process.communicate()
