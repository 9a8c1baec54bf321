"""The folder of a run: names of its files, creation, lock, config and seed.

This module does not import JAX, so that the command line can use it and start fast.
"""

from __future__ import annotations

import contextlib
import json
import os
import shlex
import shutil
import time
from collections.abc import Iterator
from pathlib import Path

from vsearch_jax.config import Config, ConfigError
from vsearch_jax.runs.atomic import write_atomically
from vsearch_jax.runs.old_versions import with_later_fields

try:
    import fcntl
except ImportError:  # Windows has no fcntl. There, two processes can write into one folder.
    fcntl = None

CONFIG = "config.json"
CHECKPOINTS = "checkpoints"
METRICS = "metrics.jsonl"
EVENTS = "tensorboard"

MAX_SEED = 2**32 - 1
"""Largest seed. JAX keeps 32 bits of a seed, so a larger seed would give the same run as a smaller one."""

_REMEDY = "restore the file from a copy, or train into another folder"
_NUM_REMOVALS, _SECONDS_BETWEEN_REMOVALS = 40, 0.05


class RunError(ValueError):
    """The folder of a run exists already, is missing, is incomplete or is in use. The message names the remedy."""


class ConfigFileError(ConfigError):
    """The file `config.json` of a run is damaged, or a value in it is out of range. The message names the remedy."""


def resume_command(run: Path) -> str:
    """Returns the command line that continues a run, for error messages: it can be pasted into a shell."""
    return f"vsearch train --out {shlex.quote(str(run))} --resume"


def make_new_folder(folder: Path) -> None:
    """Makes the folder for new files, such as a run or an export. An existing empty folder is accepted.

    Raises:
      RunError: the folder is not empty or cannot be made, or `folder` is a file.
    """
    if folder.exists() and not (folder.is_dir() and not any(folder.iterdir())):
        is_run = (folder / CONFIG).is_file()
        hint = f", or continue the run in it: {resume_command(folder)}" if is_run else ""
        raise RunError(f"`folder` is {folder}, which exists; name another folder{hint}")
    _make_folder("folder", folder, folder)


def check_new_file(path: Path, suffix: str) -> None:
    """Checks that a new file can be made at `path`, and makes the folder for it.

    Args:
      path: the file to be made.
      suffix: how the name of the file must end, for example ".mp4".

    Raises:
      RunError: something exists at `path`, the name does not end in `suffix`, or the folder cannot be made.
    """
    if path.suffix.lower() != suffix:
        raise RunError(f"`path` is {path}; name a file that ends in {suffix}")
    if path.exists():
        raise RunError(f"`path` is {path}, which exists; name another file")
    _make_folder("path", path, path.parent)


def _make_folder(option: str, value: Path, folder: Path) -> None:
    """Makes `folder`, where a file or folder `value` is to be; an error names the option that gave `value`."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        reason = f"the folder {folder} cannot be made ({error.strerror})"
        raise RunError(f"`{option}` is {value}, but {reason}; name another folder") from error


@contextlib.contextmanager
def new_run_folder(run: Path) -> Iterator[None]:
    """Makes the folder of a new run for a `with` block, which writes the run's first files.

    If the block raises an exception, config and checkpoints are removed. The folder is then empty again.

    Args:
      run: the new folder. An existing empty folder is accepted.

    Raises:
      RunError: the folder is not empty, or `run` is a file.
    """
    make_new_folder(run)
    try:
        yield
    except BaseException:
        (run / CONFIG).unlink(missing_ok=True)
        _remove(run / CHECKPOINTS)
        raise


def _remove(folder: Path) -> None:
    """Removes a folder into which threads of a failed save may still write."""
    for _ in range(_NUM_REMOVALS):
        shutil.rmtree(folder, ignore_errors=True)
        time.sleep(_SECONDS_BETWEEN_REMOVALS)
        if not folder.exists():
            return


@contextlib.contextmanager
def lock_folder(run: Path) -> Iterator[None]:
    """Locks the folder of a run against other processes until the `with` block ends.

    The lock also ends with this process. Nothing is locked if the folder does not exist, or if the system or the file
    system has no locks.

    Raises:
      RunError: another process has locked the folder.
    """
    if fcntl is None or not run.is_dir():
        yield
        return
    descriptor = os.open(run, os.O_RDONLY)
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise RunError(f"another process uses {run}; wait for it or stop it, or name another folder") from error
        except OSError:
            pass  # The file system has no locks.
        yield
    finally:
        os.close(descriptor)


def write_config(run: Path, config: Config, seed: int) -> None:
    """Writes config and seed of a run to `config.json` in the run's folder.

    Args:
      run: folder of the run.
      config: the run's config.
      seed: the run's seed, from 0 to `MAX_SEED`.

    Raises:
      OSError: the disk is full or not writable.
    """
    write_atomically(run / CONFIG, json.dumps({"seed": seed, **config.to_dict()}, indent=2) + "\n")


def read_config(run: Path) -> Config:
    """Reads the config of a run from `config.json` in the run's folder.

    Raises:
      RunError: the folder holds no run.
      ConfigFileError: `config.json` is damaged, or a value in it is out of range.
    """
    values = {name: value for name, value in _read_json(run).items() if name != "seed"}
    try:
        return Config.from_dict(with_later_fields(values))
    except (ValueError, TypeError, AttributeError) as error:  # a value is out of range or has a wrong type
        raise ConfigFileError(f"{run / CONFIG}: {error}; {_REMEDY}") from error


def read_seed(run: Path) -> int:
    """Reads the seed of a run from `config.json` in the run's folder.

    Raises:
      RunError: the folder holds no run.
      ConfigFileError: `config.json` is damaged, or the seed is out of range.
    """
    seed = _read_json(run).get("seed")
    if not isinstance(seed, int) or not 0 <= seed <= MAX_SEED:
        raise ConfigFileError(f"{run / CONFIG}: seed is {seed!r}; allowed: 0 to {MAX_SEED}; {_REMEDY}")
    return seed


def _read_json(run: Path) -> dict[str, object]:
    """Reads the object in `config.json`."""
    path = run / CONFIG
    if not path.is_file():
        raise RunError(f"no run in {run}: {CONFIG} is missing; name a folder that `vsearch train --out` made")
    try:
        values = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise ConfigFileError(f"{path} is not JSON ({error}); {_REMEDY}") from error
    if not isinstance(values, dict):
        raise ConfigFileError(f"{path} holds no JSON object; {_REMEDY}")
    return values
