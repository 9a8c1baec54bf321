"""Entry point of the command `vsearch`.

Slow modules are imported after the command line is parsed, so that --help is fast.
"""

from __future__ import annotations

import contextlib
import io
import os
import signal
import sys
from collections.abc import Sequence

from vsearch_jax.cli.commands import COMMANDS, Command, Info, Train
from vsearch_jax.cli.errors import is_user_error
from vsearch_jax.cli.option_names import use_option_names
from vsearch_jax.cli.output import OutputError, checked_output, discard_output
from vsearch_jax.cli.parse import parse
from vsearch_jax.runs.folder import ConfigFileError, resume_command

_NOTHING_SAVED = " before anything was saved; give the same command again to start again"
INTERRUPTED = 130
"""Exit status after Ctrl-C: 128 + SIGINT, as in shells."""
PIPE_CLOSED = 141
"""Exit status if the reader of standard output has ended: 128 + SIGPIPE, as in shells."""
USER_ERROR = 2
"""Exit status after an error that the user can correct."""


def main(arguments: Sequence[str] | None = None) -> None:
    """Runs the command `vsearch` with the given command line.

    Args:
      arguments: the command line without the name of the program; `sys.argv` by default.

    Raises:
      SystemExit: with status 0 after --help, 1 if the self-test of `info` fails, 2 after an error of the user, 141 if
        the reader of standard output has ended. If a signal interrupts the command, the process ends with status 130.
    """
    arguments = sys.argv[1:] if arguments is None else arguments
    for number in (signal.SIGTERM, signal.SIGINT):  # Shells start background jobs with SIGINT ignored.
        signal.signal(number, signal.default_int_handler)
    with checked_output():
        _call(arguments)


def _call(arguments: Sequence[str]) -> None:
    """Parses and runs a command. Turns each expected exception into an exit status and one line of message."""
    command = None
    try:
        command = parse(arguments)
        _run(command)
    except KeyboardInterrupt:
        with contextlib.suppress(OSError):
            print(f"\nvsearch: {_describe_interrupt(command)}", file=sys.stderr, flush=True)
        # A computation may still run in its thread. The interpreter would wait for it.
        os._exit(INTERRUPTED)
    except OutputError as error:
        discard_output()
        if error.is_closed:  # As other programs do that a pipe feeds: they end silently.
            sys.exit(PIPE_CLOSED)
        print(f"vsearch: error: {error}{_describe_saved(command)}", file=sys.stderr)
        sys.exit(USER_ERROR)
    except (ValueError, OSError) as error:
        if not is_user_error(error):
            raise
        name = arguments[0] if arguments else ""
        print(f"vsearch: error: {_describe_error(error, name, command)}", file=sys.stderr)
        sys.exit(USER_ERROR)


def _run(command: Command) -> None:
    # MJX prints at import that Warp is missing. Nothing here needs Warp.
    from vsearch_jax.cli.devices import check_devices

    if isinstance(command, Info):
        with contextlib.redirect_stdout(io.StringIO()):
            from vsearch_jax.cli import info
        if not info.print_info():
            sys.exit(1)
    else:
        check_devices()
        with contextlib.redirect_stdout(io.StringIO()):
            from vsearch_jax.cli import run_commands
        run_commands.run_command(command)


def _describe_error(error: Exception, name: str, command: Command | None) -> str:
    """Returns the message for the user.

    Args:
      error: the error.
      name: name of the subcommand.
      command: the parsed command, None if parsing failed.
    """
    if isinstance(error, OSError) and error.errno is not None and error.filename is None:
        # The system names the cause but no file. It is a write into the folder of the command, on a full disk.
        folder = getattr(command, "out", None) or getattr(command, "run", None)
        return f"cannot write to {folder}: {error.strerror}"
    # In a message about a file, the names of fields are those in the file.
    if name not in COMMANDS or isinstance(error, OSError | ConfigFileError):
        return str(error)
    return use_option_names(str(error), COMMANDS[name])


def _describe_interrupt(command: Command | None) -> str:
    if not isinstance(command, Train):
        return "interrupted"
    return f"interrupted{_describe_saved(command) or _NOTHING_SAVED}"


def _describe_saved(command: Command | None) -> str:
    """Returns the end of a message that says what a training has saved; empty if it has saved nothing."""
    if not isinstance(command, Train):
        return ""
    from vsearch_jax.runs.checkpoint import latest_step

    step = latest_step(command.out)
    return "" if step is None else f"; {step} iterations are saved. Resume with: {resume_command(command.out)}"


if __name__ == "__main__":
    main()
