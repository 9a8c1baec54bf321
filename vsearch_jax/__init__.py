"""View search end to end in JAX: find the view that a target image shows, with a camera on an arm.

The names are imported when they are first used, so that `vsearch --help` need not wait for JAX.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from vsearch_jax import planning, render, search
    from vsearch_jax.config import Config
    from vsearch_jax.env import ViewSearchEnv
    from vsearch_jax.evaluation import evaluate
    from vsearch_jax.robot.arm import build_arm
    from vsearch_jax.scene import build_scene
    from vsearch_jax.training import init, train
    from vsearch_jax.types import Camera

__all__ = [
    "Camera",
    "Config",
    "ViewSearchEnv",
    "build_arm",
    "build_scene",
    "evaluate",
    "init",
    "planning",
    "render",
    "search",
    "train",
]

_HOMES = {
    "Camera": "types",
    "Config": "config",
    "ViewSearchEnv": "env",
    "build_arm": "robot.arm",
    "build_scene": "scene",
    "evaluate": "evaluation",
    "init": "training",
    "train": "training",
}


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    home = importlib.import_module(f"{__name__}.{_HOMES.get(name, name)}")
    return getattr(home, name) if name in _HOMES else home


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
