"""View search in JAX: find the view that a target image shows, with a camera on a robot arm.

Each public name is imported at its first use. So `import vsearch_jax` loads neither JAX nor MuJoCo, and
`vsearch --help` starts fast.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from vsearch_jax import planning, render, search
    from vsearch_jax.config import Config
    from vsearch_jax.env import ViewSearchEnv
    from vsearch_jax.evaluation import evaluate
    from vsearch_jax.robot.arm import build_arm
    from vsearch_jax.scene import build_scene
    from vsearch_jax.training import init, train
    from vsearch_jax.types import Camera

    __version__: str

__all__ = [
    "Camera",
    "Config",
    "ViewSearchEnv",
    "__version__",
    "build_arm",
    "build_scene",
    "evaluate",
    "init",
    "planning",
    "render",
    "search",
    "train",
]

_MODULE_OF_NAME = {
    "Camera": "types",
    "Config": "config",
    "ViewSearchEnv": "env",
    "build_arm": "robot.arm",
    "build_scene": "scene",
    "evaluate": "evaluation",
    "init": "training",
    "train": "training",
}
"""Module of each public name that is not a module itself."""


def __getattr__(name: str) -> object:
    """Imports the public name `name` at its first use.

    Raises:
      AttributeError: `name` is not public.
    """
    if name == "__version__":
        from importlib.metadata import version

        return version(__name__)
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module = importlib.import_module(f"{__name__}.{_MODULE_OF_NAME.get(name, name)}")
    return getattr(module, name) if name in _MODULE_OF_NAME else module


def __dir__() -> list[str]:
    """Returns the names of the module, the lazy ones included."""
    return sorted({*globals(), *__all__})
