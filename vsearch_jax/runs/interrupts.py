"""Ctrl-C and SIGTERM during long computations.

The first signal lets the running chunk end. The second signal stops at once.
"""

from __future__ import annotations

import concurrent.futures
import contextlib
import signal
import threading
from collections.abc import Callable, Iterator
from typing import ParamSpec, TypeVar

import jax

P = ParamSpec("P")
T = TypeVar("T")

OnInterrupt = Callable[[], None]
"""Called at the first signal, when the running chunk becomes the last one."""


@contextlib.contextmanager
def stop_on_signal(on_interrupt: OnInterrupt) -> Iterator[threading.Event]:
    """Lets a `with` block stop in good order: handles Ctrl-C (SIGINT) and SIGTERM while the block runs.

    The first signal sets an event, which the block must poll. The second signal raises KeyboardInterrupt.
    Python delivers signals to the main thread only. In another thread the event is never set.

    Args:
      on_interrupt: called at the first signal.

    Yields:
      The event that the first signal sets.
    """
    event = threading.Event()

    def handle(number: int, frame: object) -> None:
        if event.is_set():
            raise KeyboardInterrupt
        event.set()
        with contextlib.suppress(RuntimeError):  # The signal may arrive inside a print, which cannot be entered twice.
            on_interrupt()

    if threading.current_thread() is not threading.main_thread():
        yield event
        return
    previous = {number: signal.signal(number, handle) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield event
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


def call_interruptibly(function: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
    """Calls `function(*args, **kwargs)` so that Ctrl-C or SIGTERM can interrupt the call at once.

    Python runs a signal handler in the main thread, between two Python instructions. A call of a compiled function is
    one instruction and may take hours. So the call runs in another thread. An interrupt abandons that thread.

    Args:
      function: the function to call.
      *args: positional arguments of the function.
      **kwargs: keyword arguments of the function.

    Returns:
      The function's result, after all arrays in it are computed.

    Raises:
      BaseException: the exception that the function raised, or that a signal handler raised.
    """
    future: concurrent.futures.Future[T] = concurrent.futures.Future()

    def call() -> None:
        try:
            future.set_result(jax.block_until_ready(function(*args, **kwargs)))
        except BaseException as error:
            future.set_exception(error)

    threading.Thread(target=call, daemon=True).start()
    return future.result()
