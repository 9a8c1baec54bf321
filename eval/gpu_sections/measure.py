"""Settings of a run, and how compile time, rate and memory are measured."""

from __future__ import annotations

import dataclasses
import gc
import statistics
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import TypeVar

import jax

T = TypeVar("T")
Row = dict[str, str | int | float | bool | None]

# A call longer than this is timed once.
LONG_CALL_SECONDS = 5.0


@dataclass(frozen=True)
class Settings:
    """What a section needs to know.

    Attributes:
      is_quick: use sizes that two CPU cores finish in seconds.
      deadline: `time.perf_counter()` after which no new measurement begins.
      seconds: how long each rate is measured, in s.
    """

    is_quick: bool
    deadline: float
    seconds: float

    @property
    def seconds_left(self) -> float:
        """Seconds until the deadline; negative after it."""
        return self.deadline - time.perf_counter()

    def share(self, part: float) -> Settings:
        """Returns settings for one section that may use `part` (0 to 1) of the time left."""
        return dataclasses.replace(self, deadline=time.perf_counter() + part * max(self.seconds_left, 0.0))


@dataclass(frozen=True)
class Compiled:
    """A compiled program.

    Attributes:
      call: runs the program once and waits for its result.
      seconds: tracing and compilation, in s.
      mib: memory of temporaries and results, in MiB; None where the backend does not tell.
    """

    call: Callable[[], object]
    seconds: float
    mib: float | None


def compile_program(function: Callable[..., T], *arguments: object) -> Compiled:
    """Compiles `function` for `arguments` without running it."""
    began = time.perf_counter()
    program = jax.jit(function).lower(*arguments).compile()
    seconds = time.perf_counter() - began
    memory = program.memory_analysis()
    mib = None if memory is None else (memory.temp_size_in_bytes + memory.output_size_in_bytes) / 2**20
    return Compiled(lambda: jax.block_until_ready(program(*arguments)), seconds, mib)


def rate(call: Callable[[], object], count: int, seconds: float) -> float:
    """Returns items per second: the median over repeated calls, or that of the first call if it is long.

    Args:
      call: processes `count` items and waits for the result.
      count: items of one call.
      seconds: how long to repeat, in s; at least three calls are timed after a first one.
    """
    began = time.perf_counter()
    call()
    first = time.perf_counter() - began
    if first > LONG_CALL_SECONDS:
        return count / first
    times: list[float] = []
    end = time.perf_counter() + seconds
    while time.perf_counter() < end or len(times) < 3:
        began = time.perf_counter()
        call()
        times.append(time.perf_counter() - began)
    return count / statistics.median(times)


def measure(name: str, count: int, settings: Settings, function: Callable[..., T], *arguments: object) -> Row:
    """Compiles and times a program of `count` items.

    Returns:
      One row. It has `error` where memory or time ran out.
    """
    row: Row = {"what": name, "batch": count}
    if settings.seconds_left < 0.0:
        return row | {"error": "not run: out of time"}
    try:
        program = compile_program(function, *arguments)
        row |= {"compile_s": program.seconds, "memory_mib": program.mib}
        row["per_second"] = rate(program.call, count, settings.seconds)
    except jax.errors.JaxRuntimeError as error:
        if "RESOURCE_EXHAUSTED" not in str(error):
            raise
        row["error"] = "out of memory"
    finally:
        gc.collect()
    return row


def sweep(batches: list[int], run: Callable[[int], Row]) -> Iterator[Row]:
    """Yields a row for each batch size (ascending) and stops at the first one that has `error`."""
    for batch in batches:
        row = run(batch)
        yield row
        if "error" in row:
            return
