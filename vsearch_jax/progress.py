"""What a person sees of a run while it trains: a bar on a terminal, a line a chunk in a file."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from vsearch_jax.config import Config

_LOSSES = {"encoder": "encoder_loss", "policy": "critic_loss"}


@contextlib.contextmanager
def training_progress(console: Console, config: Config, step: int) -> Iterator[Callable[..., None]]:
    """Shows the progress of training inside its block.

    Args:
      console: where to.
      config: the run's config.
      step: iterations done before.

    Yields:
      A function to call after each chunk with the iterations done, the chunk's wall time in s and its metrics' lines.
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
    task = bar.add_task("compiling", total=config.num_iterations, completed=step)

    def update(new_step: int, seconds: float, lines: Sequence[Mapping[str, Any]]) -> None:
        text = describe(seconds, lines)
        bar.update(task, completed=new_step, description=text)
        if not console.is_terminal:
            console.print(f"{new_step}/{config.num_iterations} {text}", highlight=False)

    with bar:
        yield update


def describe(seconds: float, lines: Sequence[Mapping[str, Any]]) -> str:
    """Returns stage, rate, loss and, once there are any, reward and success of a chunk, means over its iterations."""
    stage = lines[-1]["stage"]
    parts = [stage, f"{len(lines) / seconds:.1f} iterations/s"]
    for name, key in {"loss": _LOSSES[stage], "reward": "reward", "success": "success_rate"}.items():
        values = [line[key] for line in lines if key in line]
        if values:
            parts.append(f"{name} {sum(values) / len(values):.4g}")
    return ", ".join(parts)
