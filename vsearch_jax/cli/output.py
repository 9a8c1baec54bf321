"""Standard output of the command: characters that it cannot show, and errors of writing that are its own."""

from __future__ import annotations

import contextlib
import io
import os
import sys
from collections.abc import Iterator
from typing import TextIO, cast


class OutputError(Exception):
    """Standard output cannot be written to.

    It is no OSError, so that nobody takes it for an error of a file.

    Attributes:
      is_closed: its reader has ended, as `head` does.
    """

    def __init__(self, error: OSError) -> None:
        """Keeps the cause: the OSError of the write."""
        super().__init__(f"cannot write to standard output: {error.strerror}")
        self.is_closed = isinstance(error, BrokenPipeError)


class _Output:
    """A text stream that shows each text at once and whose errors of writing are OutputErrors."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def write(self, text: str) -> int:
        """Writes the text, and flushes it: a file or pipe is read while the command still runs."""
        try:
            count = self._stream.write(text)
            self._stream.flush()
        except OSError as error:
            raise OutputError(error) from error
        return count

    def flush(self) -> None:
        """Does nothing: `write` flushes."""

    def __getattr__(self, name: str) -> object:
        return getattr(self._stream, name)


@contextlib.contextmanager
def checked_output() -> Iterator[None]:
    """Makes standard output raise OutputError in a `with` block, and replace characters that it cannot show."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")
    # Python sets a stream to None if the shell has closed it.
    with open(os.devnull, "w", encoding="utf-8") as nowhere:
        output = cast(TextIO, _Output(sys.stdout or nowhere))
        with contextlib.redirect_stdout(output), contextlib.redirect_stderr(sys.stderr or nowhere):
            yield


def discard_output() -> None:
    """Discards what standard output still holds, which Python would try to write at its end."""
    with contextlib.suppress(OSError, ValueError):  # The stream may have no file descriptor.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
