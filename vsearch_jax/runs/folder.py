"""A run's folder on disk: never silently reused, its files replaced whole or not at all."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from vsearch_jax.config import Config, ConfigError
from vsearch_jax.runs.atomic import write_atomically

try:
    import fcntl
except ImportError:  # not on Windows, where two processes on one folder go unnoticed
    fcntl = None

CONFIG = "config.json"
CHECKPOINTS = "checkpoints"
METRICS = "metrics.jsonl"
EVENTS = "tensorboard"


MAX_SEED = 2**32 - 1
"""Seeds are numbers of 32 bits: jax would cut a larger one, and two seeds would be one."""


class RunError(ValueError):
    """A run's folder is in the way, missing or incomplete; the message says which and what to do."""


def make_new_folder(folder: Path) -> None:
    """Makes the folder `folder` for new files; an empty one that exists will do.

    Raises:
      RunError: the folder holds something, or a file stands in its place.
    """
    if folder.exists() and not (folder.is_dir() and not any(folder.iterdir())):
        is_run = (folder / CONFIG).is_file()
        hint = f", or go on with the run in it: vsearch train --out {folder} --resume" if is_run else ""
        raise RunError(f"{folder} exists; name another folder with --out{hint}")
    folder.mkdir(parents=True, exist_ok=True)


def check_new_file(path: Path, suffix: str) -> None:
    """Checks that nothing is at `path`, where a new file is to be made, and makes its folder.

    Raises:
      RunError: something is there, or the name does not end in `suffix`.
    """
    if path.suffix.lower() != suffix:
        raise RunError(f"{path} does not end in {suffix}; name a file that does with --out")
    if path.exists():
        raise RunError(f"{path} exists; name another file with --out")
    path.parent.mkdir(parents=True, exist_ok=True)


@contextlib.contextmanager
def new_run_folder(run: Path) -> Iterator[None]:
    """Makes the folder `run` for a new run, and takes away what the block that is to start the run wrote if it fails.

    Raises:
      RunError: see `make_new_folder`.
    """
    make_new_folder(run)
    try:
        yield
    except BaseException:
        (run / CONFIG).unlink(missing_ok=True)
        _remove(run / CHECKPOINTS)
        raise


def _remove(folder: Path) -> None:
    # A save that failed on one array may still write others, and may make the folder anew to do so.
    for _ in range(40):
        shutil.rmtree(folder, ignore_errors=True)
        time.sleep(0.05)
        if not folder.exists():
            return


@contextlib.contextmanager
def lock_folder(run: Path) -> Iterator[None]:
    """Keeps other processes out of the folder `run`, if there is one, for as long as the block or this process lives.

    Raises:
      RunError: another process is at work in the folder.
    """
    if fcntl is None or not run.is_dir():
        yield
        return
    descriptor = os.open(run, os.O_RDONLY)
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise RunError(
                f"another process is at work in {run}; wait for it or stop it, or name another folder"
            ) from error
        except OSError:
            pass  # a file system without locks
        yield
    finally:
        os.close(descriptor)


def write_config(run: Path, config: Config, seed: int) -> None:
    """Writes `config.json`, the run's seed in it; the other half are `read_config` and `read_seed`."""
    write_atomically(run / CONFIG, json.dumps({"seed": seed, **config.to_dict()}, indent=2) + "\n")


def read_config(run: Path) -> Config:
    """Returns the config of the run in the folder `run`.

    Raises:
      RunError: there is no such folder, or no run in it.
      ConfigError: config.json is damaged or holds a value out of its range.
    """
    values = {name: value for name, value in _read(run).items() if name != "seed"}
    try:
        return Config.from_dict(values)
    except (ValueError, TypeError, AttributeError) as error:  # out of its range, or of another type
        raise ConfigError(f"{run / CONFIG}: {error}; {_REPAIR}") from error


def read_seed(run: Path) -> int:
    """Returns the seed of the run in the folder `run`; raises as `read_config`."""
    seed = _read(run).get("seed")
    if not isinstance(seed, int) or not 0 <= seed <= MAX_SEED:
        raise ConfigError(f"{run / CONFIG}: seed is {seed!r}, no whole number from 0 to {MAX_SEED}; {_REPAIR}")
    return seed


_REPAIR = "restore it, or train into another folder"


def _read(run: Path) -> dict[str, Any]:
    path = run / CONFIG
    if not path.is_file():
        raise RunError(f"no run in {run}: {CONFIG} is missing; name a folder that `vsearch train --out` made")
    try:
        values = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise ConfigError(f"{path} is not JSON ({error}); {_REPAIR}") from error
    if not isinstance(values, dict):
        raise ConfigError(f"{path} holds no JSON object; {_REPAIR}")
    return values
