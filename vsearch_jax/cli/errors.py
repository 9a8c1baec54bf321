"""Errors that the user can correct. Their messages have one line and name the remedy."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Iterator


def is_user_error(error: ValueError | OSError) -> bool:
    """Returns whether a user can correct an error. Errors of this package name a remedy; other ValueErrors are bugs."""
    return isinstance(error, OSError) or type(error).__module__.startswith("vsearch_jax.")


@contextlib.contextmanager
def one_line_errors() -> Iterator[None]:
    """Lets a script end with one line of message, and status 2, where the `with` block raises an error of the user."""
    try:
        yield
    except (ValueError, OSError) as error:
        if not is_user_error(error):
            raise
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)
