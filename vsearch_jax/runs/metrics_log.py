"""The metrics of a run on disk: `metrics.jsonl` and TensorBoard events. Each iteration has exactly one line."""

from __future__ import annotations

import importlib
import json
import math
import os
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from tensorboardX.event_file_writer import EventsWriter
from tensorboardX.summary import scalar

from vsearch_jax.runs.atomic import write_atomically
from vsearch_jax.runs.folder import EVENTS, METRICS, RunError

_PB2: Any = importlib.import_module("tensorboardX.proto.event_pb2")
"""Generated code: its classes have no types."""

MetricsLine: TypeAlias = dict[str, Any]
"""One line of `metrics.jsonl`: `iteration` int, `stage` str, `seconds` float, and a float for each metric."""

STAGES = ("encoder", "policy")
"""Names of the stages. The metric `stage` is an index into this tuple."""


def read_metrics(run: Path) -> list[MetricsLine]:
    """Reads the training metrics of a run from `metrics.jsonl` in the run's folder.

    A killed process may leave an incomplete last line, which is ignored.

    Returns:
      One dictionary for each iteration; an empty list if there is no file.

    Raises:
      RunError: a complete line is damaged.
    """
    path = run / METRICS
    if not path.is_file():
        return []
    # Damaged bytes become replacement characters, which are not valid JSON.
    text = path.read_text(encoding="utf-8", errors="replace")
    complete = text[: text.rfind("\n") + 1]
    return [_parse_line(path, number, line) for number, line in enumerate(complete.splitlines(), 1)]


def _parse_line(path: Path, number: int, text: str) -> MetricsLine:
    error = RunError(f"{path}: line {number} is damaged; restore the file from a copy, or train into another folder")
    try:
        line = json.loads(text)
        is_valid = line["stage"] in STAGES and isinstance(line["iteration"], int) and line["seconds"] >= 0.0
    except (ValueError, TypeError, KeyError):
        raise error from None
    if not is_valid:
        raise error
    return line


class MetricsLog:
    """Appends training metrics to the files of a run: `metrics.jsonl` and TensorBoard events.

    Attributes:
      lines: all lines of `metrics.jsonl`.
    """

    lines: list[MetricsLine]

    def __init__(self, run: Path, step: int) -> None:
        """Opens the logs. Lines of iteration `step` and later are removed.

        Args:
          run: folder of the run.
          step: number of iterations done.

        Raises:
          RunError: a line of `metrics.jsonl` is damaged.
          OSError: the disk is full or not writable.
        """
        self.lines = [line for line in read_metrics(run) if line["iteration"] < step]
        self._path = run / METRICS
        write_atomically(self._path, "".join(json.dumps(line) + "\n" for line in self.lines))
        (run / EVENTS).mkdir(exist_ok=True)
        # Not SummaryWriter: it writes in a thread, where an error of the disk is a traceback and no exception.
        self._events = EventsWriter(str(run / EVENTS / "events"))
        # TensorBoard hides the events of this step and later from files before this one.
        start = _PB2.SessionLog(status=_PB2.SessionLog.START)
        self._add_event(_PB2.Event(step=step, session_log=start))
        self._events.flush()

    def append(self, metrics: Mapping[str, np.ndarray], first: int, seconds: float) -> None:
        """Appends the metrics of a chunk of n iterations, one line for each, and waits until the lines are on disk.

        Args:
          metrics: `stage` i32[n], index into `STAGES`; each other metric f32[n], NaN in iterations of another stage.
          first: number of the chunk's first iteration.
          seconds: wall time of the chunk in s. Each line gets an equal share.

        Raises:
          OSError: the disk is full or not writable.
        """
        stages = metrics["stage"]
        new = []
        for i, stage in enumerate(stages):
            line: MetricsLine = {"iteration": first + i, "stage": STAGES[stage], "seconds": seconds / len(stages)}
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
                summary = scalar(f"{line['stage']}/{name}", line[name])
                self._add_event(_PB2.Event(step=line["iteration"], summary=summary))
        self._events.flush()
        self.lines += new

    def _add_event(self, event: Any) -> None:
        event.wall_time = time.time()
        self._events.write_event(event)

    def close(self) -> None:
        """Closes the TensorBoard events file. `metrics.jsonl` needs no closing."""
        self._events.close()
