"""What a person sees of a run while it trains: a bar on a terminal, a line a chunk in a file."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from vsearch_jax.config import Config

_LOSSES = {"encoder": "encoder_loss", "policy": "critic_loss"}


class TrainingProgress:
    """What the loop of chunks reports to.

    Attributes:
      bar: the bar on the terminal.
      console: where the lines of the chunks go where there is no terminal.
      config: the run's config.
    """

    def __init__(self, bar: Progress, console: Console, config: Config, step: int) -> None:
        """Starts the bar at iteration `step`."""
        self.bar, self.console, self.config = bar, console, config
        self._task = bar.add_task("compiling", total=config.num_iterations, completed=step)

    def update(self, step: int, seconds: float, lines: Sequence[Mapping[str, Any]]) -> None:
        """Shows a chunk: `step` iterations done, its wall time in s, its lines of metrics.jsonl."""
        text = describe(seconds, lines)
        self.bar.update(self._task, completed=step, description=text)
        if not self.console.is_terminal:
            self.console.print(f"{step}/{self.config.num_iterations} {text}", highlight=False)

    def stopping(self) -> None:
        """Says that the running chunk is the last."""
        self.bar.update(self._task, description="stopping after this chunk")
        self.console.print("stopping after this chunk; interrupt again to leave it unsaved", highlight=False)


@contextlib.contextmanager
def training_progress(console: Console, config: Config, step: int) -> Iterator[TrainingProgress]:
    """Shows the progress of training inside its block.

    Args:
      console: where to.
      config: the run's config.
      step: iterations done before.

    Yields:
      What to report to.
    """
    bar = Progress(
        SpinnerColumn(),
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.completed:.0f}/{task.total:.0f}"),
        TimeElapsedColumn(),
        TextColumn("ETA"),
        TimeRemainingColumn(),
        console=console,
        disable=not console.is_terminal,
    )
    with bar:
        yield TrainingProgress(bar, console, config, step)


def describe(seconds: float, lines: Sequence[Mapping[str, Any]]) -> str:
    """Returns stage, rate, loss and, once there are any, reward and success of a chunk, means over its iterations."""
    stage = lines[-1]["stage"]
    parts = [stage, f"{len(lines) / seconds:.1f} iterations/s"]
    for name, key in {"loss": _LOSSES[stage], "reward": "reward", "success": "success_rate"}.items():
        values = [line[key] for line in lines if key in line]
        if values:
            parts.append(f"{name} {sum(values) / len(values):.4g}")
    return ", ".join(parts)
