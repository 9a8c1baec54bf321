"""What every test runs under: the CPU, the compilation cache of the checkout, strict promotion of types and ranks."""

import gc
import os
from pathlib import Path

CACHE = Path(__file__).resolve().parent.parent / ".cache"

# Before jax is imported, which reads them once; the commands that tests start inherit them.
os.environ.setdefault("JAX_PLATFORMS", "cpu")
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(CACHE / "jax"))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.5")
os.environ.setdefault("MPLBACKEND", "agg")
# Most of the time goes to compilation. With less of XLA's optimisation it takes half as long, and the tests run alike.
os.environ.setdefault("XLA_FLAGS", "--xla_backend_optimization_level=1")

# Tracing makes millions of objects that live on. To look through them all again and again takes a sixth of its time.
gc.set_threshold(100_000, 20, 20)

import hypothesis  # noqa: E402 # below the settings above
import jax  # noqa: E402 # reads the variables above
import pytest  # noqa: E402 # below the settings above

jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_numpy_dtype_promotion", "strict")
# Examples are the same in every run; how long one takes depends on the machine.
hypothesis.settings.register_profile("repeatable", derandomize=True, deadline=None, database=None, max_examples=30)
hypothesis.settings.load_profile("repeatable")

# Files that take minutes, each on one worker: they start first, so that none is left alone at the end.
LONG = (
    "test_training.py",
    "test_lowering.py",
    "test_evaluation.py",
    "test_ik.py",
    "test_planning.py",
    "test_train_command.py",
    "test_interrupted_training.py",
)
JAX_VERSION = tuple(int(part) for part in jax.__version__.split(".")[:2])


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Puts long files first, and skips tests of brax's own trainers where jax lacks what they call."""
    items.sort(key=lambda item: LONG.index(item.path.name) if item.path.name in LONG else len(LONG))
    if JAX_VERSION >= (0, 10):
        reason = pytest.mark.skip(
            reason=f"brax's trainers call jax.device_put_replicated, gone from jax {jax.__version__}"
        )
        for item in items:
            if item.get_closest_marker("brax_trainer"):
                item.add_marker(reason)
