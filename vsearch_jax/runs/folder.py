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
import unicodedata
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, cast

from vsearch_jax.config import Config, ConfigError
from vsearch_jax.runs.atomic import write_atomically
from vsearch_jax.runs.old_versions import with_later_fields

if TYPE_CHECKING:  # `--help` loads this module, and must not load MuJoCo
    from vsearch_jax.scene import Fingerprint

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

_SEED, _FILES = "seed", "scene_files"
"""What `config.json` holds beside the config."""
_REMEDY = "restore the file from a copy, or train into another folder"
_UNPRINTABLE = ("Cc", "Cs", "Zl", "Zp")
"""Unicode's categories of control characters, of bytes that are no text, and of separators of lines."""
_NUM_REMOVALS, _SECONDS_BETWEEN_REMOVALS = 40, 0.05


class RunError(ValueError):
    """The folder of a run exists already, is missing, is incomplete or is in use. The message names the remedy."""


class ConfigFileError(ConfigError):
    """The file `config.json` of a run is damaged, or a value in it is out of range. The message names the remedy."""


def resume_command(run: Path) -> str:
    """Returns the command line that continues a run, for error messages: it can be pasted into a shell."""
    path = f"./{run}" if str(run).startswith("-") else str(run)  # An option would start with a hyphen.
    return f"vsearch train --out {shlex.quote(path)} --resume"


def make_new_folder(folder: Path) -> None:
    """Makes the folder for new files, such as a run or an export. An existing empty folder is accepted.

    Raises:
      RunError: the folder is not empty or cannot be made, or `folder` is a file, or its name cannot be printed.
    """
    _check_name("folder", folder)
    if _exists("folder", folder) and not (folder.is_dir() and not any(folder.iterdir())):
        is_run = (folder / CONFIG).is_file()
        hint = f", or continue the run in it: {resume_command(folder)}" if is_run else ""
        raise RunError(f"`folder` is {folder}, which exists; name another folder{hint}")
    _make_folder("folder", folder, folder)


@contextlib.contextmanager
def new_folder(folder: Path) -> Iterator[None]:
    """Makes the folder for new files, which the `with` block writes. An existing empty folder is accepted.

    If the block raises an exception, the folders that were made here are removed again, unless they hold a file.

    Raises:
      RunError: the folder is not empty or cannot be made, or `folder` is a file, or its name cannot be printed.
    """
    with _removed_after_error(folder):
        make_new_folder(folder)
        yield


@contextlib.contextmanager
def new_file(path: Path, suffix: str) -> Iterator[None]:
    """Checks that a new file can be made at `path`, and makes the folder for it. The `with` block writes the file.

    If the block raises an exception, the folders that were made here are removed again, unless they hold a file.

    Args:
      path: the file to be made.
      suffix: how the name of the file must end, for example ".mp4".

    Raises:
      RunError: something exists at `path`, the name does not end in `suffix` or cannot be printed, or the folder cannot
        be made.
    """
    _check_name("path", path)
    if path.suffix.lower() != suffix:
        raise RunError(f"`path` is {path}; name a file that ends in {suffix}")
    if _exists("path", path):
        raise RunError(f"`path` is {path}, which exists; name another file")
    with _removed_after_error(path.parent):
        _make_folder("path", path, path.parent)
        yield


@contextlib.contextmanager
def _removed_after_error(folder: Path) -> Iterator[None]:
    """Removes `folder` and its parents after an error, as far as they did not exist before and are empty."""
    missing = [path for path in (folder, *folder.parents) if not os.path.lexists(path)]
    try:
        yield
    except BaseException:
        for path in missing:
            with contextlib.suppress(OSError):  # It holds a file, or it was not made.
                path.rmdir()
        raise


def _check_name(option: str, path: Path) -> None:
    """Raises RunError if a path cannot be printed in one line; an error names the option that gave `path`."""
    if any(unicodedata.category(character) in _UNPRINTABLE for character in str(path.absolute())):
        raise RunError(
            f"`{option}` is {str(path)!a}, a path with a line break, a control character or a byte that is no "
            "text; name another path"
        )


def _exists(option: str, path: Path) -> bool:
    """Returns whether something exists at `path`; an error names the option that gave `path`."""
    try:
        path.lstat()
    except (FileNotFoundError, NotADirectoryError):
        return False
    except OSError as error:
        raise _unusable(option, path, f"the system refuses it ({error.strerror})") from error
    return True


def _make_folder(option: str, value: Path, folder: Path) -> None:
    """Makes `folder`, where a file or folder `value` is to be; an error names the option that gave `value`."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise _unusable(option, value, f"the folder {folder} cannot be made ({error.strerror})") from error


def _unusable(option: str, value: Path, reason: str) -> RunError:
    return RunError(f"`{option}` is {value}, but {reason}; name another folder")


@contextlib.contextmanager
def new_run_folder(run: Path) -> Iterator[None]:
    """Makes the folder of a new run for a `with` block, which writes the run's first files.

    If the block raises an exception, config and checkpoints are removed, and then the folder if it was made here.

    Args:
      run: the new folder. An existing empty folder is accepted.

    Raises:
      RunError: the folder is not empty, or `run` is a file, or its name cannot be printed.
    """
    with new_folder(run):
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


def write_config(run: Path, config: Config, seed: int, files: Mapping[str, object]) -> None:
    """Writes config and seed of a run, and the fingerprint of its scene, to `config.json` in the run's folder.

    Args:
      run: folder of the run.
      config: the run's config.
      seed: the run's seed, from 0 to `MAX_SEED`.
      files: fingerprint of the scene's files at the start of the run, from `scene.scene_fingerprint`; empty if unknown.

    Raises:
      OSError: the disk is full or not writable.
    """
    write_atomically(run / CONFIG, json.dumps({_SEED: seed, **config.to_dict(), _FILES: files}, indent=2) + "\n")


def read_config(run: Path) -> Config:
    """Reads the config of a run from `config.json` in the run's folder.

    Raises:
      RunError: the folder holds no run.
      ConfigFileError: `config.json` is damaged, or a value in it is out of range.
    """
    values = {name: value for name, value in _read_json(run).items() if name not in (_SEED, _FILES)}
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
    seed = _read_json(run).get(_SEED)
    if not isinstance(seed, int) or not 0 <= seed <= MAX_SEED:
        raise ConfigFileError(f"{run / CONFIG}: seed is {seed!r}; allowed: 0 to {MAX_SEED}; {_REMEDY}")
    return seed


def read_files(run: Path) -> Fingerprint:
    """Reads the fingerprint of a run's scene from `config.json`; it is empty in runs of versions before 0.3.0.

    Raises:
      RunError: the folder holds no run.
      ConfigFileError: `config.json` is damaged.
    """
    files = _read_json(run).get(_FILES, {})
    parts = files.values() if isinstance(files, dict) else [None]
    if not all(isinstance(part, dict) and isinstance(part.get("files"), dict) and "model" in part for part in parts):
        raise ConfigFileError(f"{run / CONFIG}: {_FILES} is damaged; {_REMEDY}")
    return cast("Fingerprint", files)


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
