"""Interrupts: long computations that Ctrl-C can leave, and a first signal that lets the running chunk end."""

from __future__ import annotations

import concurrent.futures
import contextlib
import signal
import threading
from collections.abc import Callable, Iterator
from typing import Any, TypeVar

import jax

T = TypeVar("T")

OnInterrupt = Callable[[], None]
"""Called when the running chunk is to be the last."""


@contextlib.contextmanager
def stop_on_signal(on_interrupt: OnInterrupt) -> Iterator[threading.Event]:
    """Yields an event that the block's first SIGINT or SIGTERM sets; a second one raises KeyboardInterrupt.

    Outside of the main thread, where Python delivers no signals, it is never set.
    """
    event = threading.Event()

    def handle(number: int, frame: object) -> None:
        if event.is_set():
            raise KeyboardInterrupt
        event.set()
        with contextlib.suppress(RuntimeError):  # the signal may have come within a print
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


def call_interruptibly(function: Callable[..., T], *arguments: Any) -> T:
    """Returns `function(*arguments)` with its arrays computed; unlike a plain call it can be interrupted at once.

    A signal's handler runs in the main thread only, and there only between two steps of Python, while one call of a
    compiled function may take hours. So the call is made in another thread, which an interrupt leaves behind.
    """
    future: concurrent.futures.Future[T] = concurrent.futures.Future()

    def call() -> None:
        try:
            future.set_result(jax.block_until_ready(function(*arguments)))
        except BaseException as error:
            future.set_exception(error)

    threading.Thread(target=call, daemon=True).start()
    return future.result()
