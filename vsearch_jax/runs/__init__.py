"""A run on disk: its folder, checkpoints, metrics, and the loop that trains it.

Each public name is imported at its first use. So `vsearch_jax.runs.folder` can be imported without JAX.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from vsearch_jax.runs.atomic import replace_file, write_atomically
    from vsearch_jax.runs.checkpoint import CheckpointError, latest_step, restore, save
    from vsearch_jax.runs.folder import RunError, make_new_folder, read_config, read_seed, write_config
    from vsearch_jax.runs.loop import Evaluated, check_finished, evaluate_run, resume_run, start_run, train_to_end
    from vsearch_jax.runs.metrics_log import MetricsLog, read_metrics

__all__ = [
    "CheckpointError",
    "Evaluated",
    "MetricsLog",
    "RunError",
    "check_finished",
    "evaluate_run",
    "latest_step",
    "make_new_folder",
    "read_config",
    "read_metrics",
    "read_seed",
    "replace_file",
    "restore",
    "resume_run",
    "save",
    "start_run",
    "train_to_end",
    "write_atomically",
    "write_config",
]

_NAMES_OF_MODULE = {
    "atomic": ("replace_file", "write_atomically"),
    "checkpoint": ("CheckpointError", "latest_step", "restore", "save"),
    "folder": ("RunError", "make_new_folder", "read_config", "read_seed", "write_config"),
    "loop": ("Evaluated", "check_finished", "evaluate_run", "resume_run", "start_run", "train_to_end"),
    "metrics_log": ("MetricsLog", "read_metrics"),
}
_MODULE_OF_NAME = {name: module for module, names in _NAMES_OF_MODULE.items() for name in names}


def __getattr__(name: str) -> object:
    """Imports the public name `name` at its first use.

    Raises:
      AttributeError: `name` is not public.
    """
    if name not in _MODULE_OF_NAME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_MODULE_OF_NAME[name]}"), name)


def __dir__() -> list[str]:
    """Returns the names of the module, the lazy ones included."""
    return sorted({*globals(), *__all__})
