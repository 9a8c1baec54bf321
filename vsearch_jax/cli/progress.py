"""Progress of the training: a bar on a terminal, one line for each chunk in a file."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence

from rich.console import Console
from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from vsearch_jax.cli.output import OutputError
from vsearch_jax.config import Config
from vsearch_jax.runs.metrics_log import MetricsLine

_LOSS_OF_STAGE = {"encoder": "encoder_loss", "policy": "critic_loss"}


class TrainingProgress:
    """Shows the progress of a run. Its methods are the callbacks of `runs.train_to_end`.

    Attributes:
      bar: the bar on the terminal.
      console: receives the lines of the chunks if there is no terminal.
      config: the run's config.
    """

    def __init__(self, bar: Progress, console: Console, config: Config, step: int) -> None:
        """Starts the bar.

        Args:
          bar: the bar on the terminal.
          console: receives the lines of the chunks if there is no terminal.
          config: the run's config.
          step: number of iterations already done.
        """
        self.bar, self.console, self.config = bar, console, config
        self._task = bar.add_task("compiling", total=config.num_iterations, completed=step)
        if not console.is_terminal:
            console.print("compiling the training", highlight=False)

    def update(self, step: int, seconds: float, lines: Sequence[MetricsLine]) -> None:
        """Shows that a chunk of iterations is done: moves the bar, or prints a line without a terminal.

        Args:
          step: number of iterations of the run that are done.
          seconds: wall time of the chunk in s.
          lines: metrics of the chunk, one entry for each iteration.
        """
        text = summarize_chunk(seconds, lines)
        self.bar.update(self._task, completed=step, description=text)
        if not self.console.is_terminal:
            self.console.print(f"{step}/{self.config.num_iterations} {text}", highlight=False, soft_wrap=True)

    def announce_stop(self) -> None:
        """Shows that the training stops after the chunk of iterations that is running."""
        self.bar.update(self._task, description="stopping after this chunk")
        with contextlib.suppress(OutputError):  # The chunk must be saved, also if Ctrl-C has ended the reader.
            text = "stopping after this chunk; interrupt again to stop now, without saving it"
            self.console.print(text, highlight=False)


def show_status(console: Console, text: str) -> contextlib.AbstractContextManager[object]:
    """Shows what is done while a `with` block runs: with a spinner on a terminal, else as a line.

    Args:
      console: the rich console to print on.
      text: what is done.
    """
    if console.is_terminal:
        return console.status(text)
    console.print(text, highlight=False)
    return contextlib.nullcontext()


@contextlib.contextmanager
def training_progress(console: Console, config: Config, step: int) -> Iterator[TrainingProgress]:
    """Shows the progress of a training while the `with` block runs: a bar on a terminal, else lines.

    Args:
      console: the rich console to print on.
      config: the run's config.
      step: number of iterations already done.

    Yields:
      The display. The block tells it of each chunk that is done.
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


def summarize_chunk(seconds: float, lines: Sequence[MetricsLine]) -> str:
    """Describes a chunk of iterations in one line: stage, iterations a second, means of loss, reward and pose success.

    Args:
      seconds: wall time of the chunk in s.
      lines: metrics of the chunk, one entry for each iteration. A metric that no entry has is left out.

    Returns:
      The line of text.
    """
    stage = lines[-1]["stage"]
    parts = [stage, f"{len(lines) / seconds:.1f} iterations/s"]
    shown = {
        "loss": _LOSS_OF_STAGE[stage],
        "false matches": "false_match_rate",
        "angle at the threshold (°)": "threshold_angle_deg",
        "reward": "reward",
        "pose success": "pose_success_rate",
    }
    for name, key in shown.items():
        values = [line[key] for line in lines if key in line]
        if values:
            parts.append(f"{name} {sum(values) / len(values):.4g}")
    return ", ".join(parts)
