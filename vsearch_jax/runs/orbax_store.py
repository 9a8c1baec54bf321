"""Writes and reads checkpoints through orbax, and tells damaged files from other faults.

Orbax and tensorstore turn paths into URLs and patterns, where characters such as `#`, `%`, `[` and `|` have a meaning.
So folders with such characters get a plain path for the time of the call: a symbolic link.
"""

from __future__ import annotations

import contextlib
import importlib.metadata
import json
import logging
import os
import re
import sys
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
import orbax.checkpoint as ocp
import tensorstore

from vsearch_jax.runs.folder import CHECKPOINTS, resume_command

NUM_KEPT = 2
"""Number of checkpoints kept in a run's folder: the last one and the one before."""

_STATE, _ABOUT = "state", "about"
_JSON_FILES = (f"{_ABOUT}/metadata", f"{_STATE}/_METADATA", "_CHECKPOINT_METADATA")
_PLAIN_PATH = re.compile(r"[\w./ -]*")
_OS_ERROR = re.compile(r"OS error (\d+)")
_DAMAGE_ERRNOS = (2, 20, 21)
"""ENOENT, ENOTDIR, EISDIR: a file of the checkpoint is missing, or is no file."""


class CheckpointError(ValueError):
    """A checkpoint is missing, damaged, unreadable, or of another config or version. The message names the remedy."""


def steps(run: Path) -> list[int]:
    """Returns the step (iterations done) of each complete checkpoint in a run's folder."""
    return [int(path.name) for path in (run / CHECKPOINTS).glob("*") if path.name.isdecimal()]


def write(run: Path, step: int, arrays: Mapping[str, np.ndarray], about: Mapping[str, object]) -> bool:
    """Writes the checkpoint of `step`, and returns when it is on disk.

    Args:
      run: folder of the run.
      step: number of iterations done.
      arrays: the arrays by name. None of them is empty.
      about: the description of the checkpoint, which JSON can store.

    Returns:
      Whether it was written. It is not if the folder holds a checkpoint of this step or of a later one.

    Raises:
      OSError: the disk is full or not writable.
      CheckpointError: orbax cannot write for another reason.
    """
    folder = run / CHECKPOINTS
    folder.mkdir(exist_ok=True)
    items = ocp.args.Composite(state=ocp.args.StandardSave(dict(arrays)), about=ocp.args.JsonSave(dict(about)))
    try:
        with _quiet_errors(), _plain_path(folder) as plain, _manager(plain) as manager:
            return manager.save(step, args=items)
    except (OSError, MemoryError):
        raise
    except Exception as error:
        errno = _errno(error)
        if errno is not None:
            raise OSError(f"cannot write a checkpoint to {folder}: {os.strerror(errno)}") from error
        raise CheckpointError(
            f"orbax-checkpoint {orbax_version()} cannot write a checkpoint to {folder} ({_describe(error)}); the "
            "earlier checkpoints are whole; install the orbax-checkpoint that constraints.txt names"
        ) from error


def read_about(run: Path, step: int) -> dict[str, object]:
    """Reads the description of the checkpoint of `step`.

    Args:
      run: folder of the run.
      step: number of iterations done.

    Raises:
      CheckpointError: the checkpoint is damaged, or orbax cannot read it for another reason.
      OSError: the system cannot read a file.
    """
    about = _read(run, step, _ABOUT, ocp.args.JsonRestore())
    assert isinstance(about, dict)  # `write` stores a dictionary
    return about


def read_arrays(run: Path, step: int, templates: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Reads the arrays of the checkpoint of `step`.

    Args:
      run: folder of the run.
      step: number of iterations done.
      templates: for each stored array an array of its shape and dtype.

    Raises:
      CheckpointError: the checkpoint is damaged, or orbax cannot read it for another reason.
      OSError: the system cannot read a file.
    """
    # The templates are numpy arrays, because orbax would place JAX arrays on the devices that saved them.
    arrays = _read(run, step, _STATE, ocp.args.StandardRestore(dict(templates)))
    assert isinstance(arrays, dict)  # orbax returns the structure of the templates
    return arrays


def damaged(run: Path, step: int, reason: str) -> CheckpointError:
    """Returns the error of a damaged checkpoint. The remedy never removes data.

    Args:
      run: folder of the run.
      step: step of the checkpoint.
      reason: what is damaged.
    """
    earlier = [other for other in steps(run) if other < step]
    remedy = "there is no other checkpoint; start a new run in another folder"
    if earlier:
        aside = f"move that folder out of {run / CHECKPOINTS} and resume from iteration {max(earlier)}"
        remedy = f"{aside}: {resume_command(run)}"
    return CheckpointError(f"checkpoint {run / CHECKPOINTS / str(step)} is damaged ({reason}); {remedy}")


def orbax_version() -> str:
    """Returns the version of orbax-checkpoint."""
    return importlib.metadata.version("orbax-checkpoint")


def _read(run: Path, step: int, item: str, arguments: ocp.args.CheckpointArgs) -> object:
    """Reads one item, `_STATE` or `_ABOUT`, of the checkpoint of `step`."""
    folder = run / CHECKPOINTS / str(step)
    # Before orbax: it reads arrays concurrently, and if one is damaged, the threads of the others print tracebacks.
    reason = _find_damage(folder)
    if reason is not None:
        raise damaged(run, step, reason)
    try:
        with _quiet_errors(), _plain_path(run / CHECKPOINTS) as plain, _manager(plain) as manager:
            return manager.restore(step, args=ocp.args.Composite(**{item: arguments}))[item]
    except (OSError, MemoryError):
        raise
    except Exception as error:  # The files are whole, so this is no damage.
        about = json.loads((folder / _ABOUT / "metadata").read_text(encoding="utf-8"))
        raise CheckpointError(
            f"orbax-checkpoint {orbax_version()} cannot read checkpoint {folder} ({_describe(error)}), but its files "
            f"are whole; install the orbax-checkpoint that wrote it ({about.get('orbax', 'see constraints.txt')})"
        ) from error


def _find_damage(folder: Path) -> str | None:
    """Reads all files of a checkpoint without orbax. Returns what is damaged, None if they are whole.

    Raises:
      OSError: the system cannot read a file.
    """
    with _plain_path(folder / _STATE) as plain:
        base = {"driver": "ocdbt", "base": {"driver": "file", "path": f"{plain}/"}}
        try:
            names = _names_of_arrays(folder)
            stored = set(tensorstore.KvStore.open(base).result().list().result())
            missing = [name for name in names if f"{name}/.zarray".encode() not in stored]
            if missing:
                return f"the array {missing[0]} is missing"
            for name in names:
                tensorstore.open({"driver": "zarr", "kvstore": base | {"path": name}}).result().read().result()
        except (FileNotFoundError, NotADirectoryError, IsADirectoryError) as error:
            return _first_line(error)
        except ValueError as error:  # from JSON and from tensorstore
            errno = _errno(error)
            if errno is None or errno in _DAMAGE_ERRNOS:
                return _first_line(error)
            raise OSError(errno, os.strerror(errno), str(folder)) from error
    return None


def _names_of_arrays(folder: Path) -> list[str]:
    """Returns the names of the arrays that a checkpoint must hold.

    Raises:
      ValueError: one of the JSON files is damaged.
      OSError: one of the JSON files is missing, or the system cannot read it.
    """
    about, *_ = [json.loads((folder / name).read_text(encoding="utf-8")) for name in _JSON_FILES]
    try:
        return [name for name, (shape, _) in about["arrays"].items() if 0 not in shape]  # Orbax stores no empty array.
    except (KeyError, TypeError, AttributeError) as error:
        raise ValueError(f"{_JSON_FILES[0]} does not list the arrays") from error


def _manager(checkpoints: Path) -> ocp.CheckpointManager:
    # Not asynchronous: the next chunk donates the arrays, and a save takes less than a second.
    options = ocp.CheckpointManagerOptions(max_to_keep=NUM_KEPT, enable_async_checkpointing=False)
    return ocp.CheckpointManager(checkpoints, options=options)


@contextlib.contextmanager
def _plain_path(folder: Path) -> Iterator[Path]:
    """Yields a path of an existing folder in which no character has a meaning for orbax and tensorstore."""
    path = folder.absolute()
    if _PLAIN_PATH.fullmatch(str(path)):
        yield path
        return
    with tempfile.TemporaryDirectory(prefix="vsearch-") as temporary:
        link = Path(temporary) / "folder"
        link.symlink_to(path, target_is_directory=True)
        yield link


@contextlib.contextmanager
def _quiet_errors() -> Iterator[None]:
    """Silences what orbax and asyncio print beside the exception that a failed read or write raises."""
    # Orbax writes arrays concurrently, and the first that fails raises. Orbax also logs a traceback for each thread.
    # The other arrays find their event loop closed, and Python reports that as an unraisable exception.
    logs, hook = [logging.getLogger(name) for name in ("absl", "asyncio")], sys.unraisablehook
    levels = [log.level for log in logs]
    for log in logs:
        log.setLevel(logging.CRITICAL)
    sys.unraisablehook = lambda report: None if str(report.exc_value) == "Event loop is closed" else hook(report)
    yield
    # Not in a `finally`: after an error the threads may end, and print, long after this block.
    sys.unraisablehook = hook
    for log, level in zip(logs, levels, strict=True):
        log.setLevel(level)


def _errno(error: Exception) -> int | None:
    """Returns the system's error number that the message of a tensorstore error holds, None if it holds none."""
    match = _OS_ERROR.search(str(error))
    return None if match is None else int(match.group(1))


def _describe(error: Exception) -> str:
    return f"{type(error).__name__}: {_first_line(error)}"


def _first_line(error: Exception) -> str:
    lines = str(error).strip().splitlines()
    return lines[0][:200] if lines else type(error).__name__
