"""The metrics of a run on disk: metrics.jsonl and TensorBoard's events; after a resume each iteration is there once."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from tensorboardX import SummaryWriter

from vsearch_jax.runs.atomic import write_atomically
from vsearch_jax.runs.folder import EVENTS, METRICS, RunError

STAGES = ("encoder", "policy")
"""Names of the values of the metric `stage`."""


def read_metrics(run: Path) -> list[dict[str, Any]]:
    """Returns the complete lines of `metrics.jsonl`, one dict an iteration; empty where there are none.

    Raises:
      RunError: a complete line is damaged.
    """
    path = run / METRICS
    if not path.is_file():
        return []
    text = path.read_text(encoding="utf-8", errors="replace")  # what is no text is no JSON either
    whole = text[: text.rfind("\n") + 1]  # a killed write leaves a last line without its end
    return [_parse(path, number, line) for number, line in enumerate(whole.splitlines(), 1)]


def _parse(path: Path, number: int, text: str) -> dict[str, Any]:
    error = RunError(f"{path}: line {number} is damaged; restore the file, or delete that line")
    try:
        line = json.loads(text)
        is_whole = line["stage"] in STAGES and isinstance(line["iteration"], int) and line["seconds"] >= 0.0
    except (ValueError, TypeError, KeyError):
        raise error from None
    if not is_whole:
        raise error
    return line


class MetricsLog:
    """Appends metrics to `metrics.jsonl` and to TensorBoard's events.

    Attributes:
      lines: every line of `metrics.jsonl`: `iteration`, `stage`, `seconds` (wall time) and the stage's metrics.
    """

    def __init__(self, run: Path, step: int) -> None:
        """Opens the logs in the folder `run` to go on at iteration `step`; what they hold of later ones is dropped."""
        self.lines = [line for line in read_metrics(run) if line["iteration"] < step]
        self._path = run / METRICS
        write_atomically(self._path, "".join(json.dumps(line) + "\n" for line in self.lines))
        self._events = SummaryWriter(str(run / EVENTS), purge_step=step)

    def append(self, metrics: Mapping[str, np.ndarray], first: int, seconds: float) -> None:
        """Appends one line for each iteration of a chunk and returns when they are on disk.

        Args:
          metrics: `stage` i32[n] (place in `STAGES`) and f32[n] under each other name, NaN where the stage lacks it.
          first: number of the chunk's first iteration.
          seconds: wall time of the chunk.
        """
        stages = metrics["stage"]
        new = []
        for i, stage in enumerate(stages):
            line: dict[str, Any] = {"iteration": first + i, "stage": STAGES[stage], "seconds": seconds / len(stages)}
            values = {name: float(column[i]) for name, column in metrics.items() if name != "stage"}
            # JSON has no NaN.
            line |= {name: value for name, value in values.items() if math.isfinite(value)}
            new.append(line)
        with self._path.open("a", encoding="utf-8") as file:
            file.write("".join(json.dumps(line) + "\n" for line in new))
            file.flush()
            os.fsync(file.fileno())
        for line in new:
            for name in line.keys() - {"iteration", "stage"}:
                self._events.add_scalar(f"{line['stage']}/{name}", line[name], line["iteration"])
        self._events.flush()
        self.lines += new

    def close(self) -> None:
        """Closes TensorBoard's events."""
        self._events.close()
