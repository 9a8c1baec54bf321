"""A run's folder on disk: never silently reused, its files replaced whole or not at all."""

from __future__ import annotations

import contextlib
import json
import shutil
from collections.abc import Iterator
from pathlib import Path

from vsearch_jax.config import Config, ConfigError

CONFIG = "config.json"
METRICS = "metrics.jsonl"
EVENTS = "tensorboard"


class RunError(ValueError):
    """A run's folder is in the way, missing or incomplete; the message says which and what to do."""


def claim(run: Path) -> None:
    """Makes the folder `run` for a new run; an empty one that exists will do.

    Raises:
      RunError: the folder holds something, or a file stands in its place.
    """
    if run.is_dir() and not any(run.iterdir()):
        return
    if run.exists():
        raise RunError(f"{run} exists; name another folder with --out, or go on with the run in it by --resume")
    run.mkdir(parents=True)


@contextlib.contextmanager
def claimed(run: Path) -> Iterator[None]:
    """Makes the folder `run` for a new run, and empties it again if the block that is to start the run fails.

    Raises:
      RunError: see `claim`.
    """
    claim(run)
    try:
        yield
    except BaseException:
        for path in run.iterdir():
            shutil.rmtree(path) if path.is_dir() else path.unlink()
        raise


def write_config(run: Path, config: Config) -> None:
    """Writes `config.json`; the other half is `read_config`."""
    write_text(run / CONFIG, json.dumps(config.to_dict(), indent=2) + "\n")


def read_config(run: Path) -> Config:
    """Returns the config of the run in the folder `run`.

    Raises:
      RunError: there is no such folder, or no run in it.
      ConfigError: config.json is damaged or holds a value out of its range.
    """
    path = run / CONFIG
    if not path.is_file():
        raise RunError(f"no run in {run}: {CONFIG} is missing; name a folder that `vsearch train --out` made")
    try:
        values = json.loads(path.read_text())
    except ValueError as error:
        raise ConfigError(f"{path} is not JSON ({error}); restore it, or train into another folder") from error
    if not isinstance(values, dict):
        raise ConfigError(f"{path} holds no JSON object; restore it, or train into another folder")
    try:
        return Config.from_dict(values)
    except (ValueError, TypeError, AttributeError) as error:  # out of its range, or of another type
        raise ConfigError(f"{path}: {error}; restore it, or train into another folder") from error


def write_text(path: Path, text: str) -> None:
    """Replaces the file `path` by `text` in one step: whoever reads it sees the old text or the new one."""
    temporary = path.with_name(f".{path.name}.tmp")
    try:
        temporary.write_text(text, encoding="utf-8")
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)
