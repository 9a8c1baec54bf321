"""Files that are replaced whole or not at all."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path


def write_atomically(path: Path, content: str | bytes) -> None:
    """Replaces the file `path` in one step: whoever reads it sees the old content or the new one."""
    with replace_file(path) as temporary:
        temporary.write_bytes(content.encode() if isinstance(content, str) else content)


@contextlib.contextmanager
def replace_file(path: Path) -> Iterator[Path]:
    """Yields an empty file beside `path`, of the same suffix, that takes its name when the block ends well."""
    temporary = path.with_name(f".{path.stem}.tmp{path.suffix}")
    try:
        with temporary.open("wb") as file:
            yield temporary
            os.fsync(file.fileno())  # else a crash of the machine may leave the new name with no content
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)
