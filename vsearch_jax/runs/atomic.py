"""Atomic replacement of files."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path


def write_atomically(path: Path, content: str | bytes) -> None:
    """Writes a file in one step. A reader sees the old content or the whole new content, never a part of it.

    Args:
      path: the file. An old file of this name is replaced.
      content: text, which is written as UTF-8, or bytes.

    Raises:
      OSError: the disk is full or not writable. The old file stays.
    """
    with replace_file(path) as temporary:
        temporary.write_bytes(content.encode() if isinstance(content, str) else content)


@contextlib.contextmanager
def replace_file(path: Path) -> Iterator[Path]:
    """Replaces the file `path` in one step at the end of a `with` block, which writes the new content.

    If the block raises an exception, the old file stays.

    Yields:
      An empty temporary file in the same folder, with the same suffix. The block writes into it.
    """
    # The stem is cut, because names may have 255 bytes only.
    temporary = path.with_name(f".{path.stem[:50]}.tmp{path.suffix}")
    try:
        with temporary.open("wb") as file:
            yield temporary
            # Without fsync, a crash of the machine can leave the new name with no content.
            os.fsync(file.fileno())
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)
