"""Where published figures come from: commit, versions and machine."""

from __future__ import annotations

import importlib.metadata
import os
import platform
import subprocess
from pathlib import Path

import jax

_PACKAGES = ("vsearch_jax", "jax", "jaxlib", "flax", "optax", "brax", "evosax", "mujoco", "mujoco-mjx", "numpy")


def provenance() -> dict[str, object]:
    """Returns commit, versions and machine, as published JSON files hold them."""
    return {"commit": commit(), "versions": versions(), "machine": machine()}


def commit() -> str | None:
    """Returns the commit of the checkout that holds the package; None where the package is installed elsewhere."""
    folder = Path(__file__).resolve().parents[2]
    if not (folder / ".git").exists():
        return None
    try:
        command = ["git", "-C", str(folder), "rev-parse", "HEAD"]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return None


def versions() -> dict[str, str]:
    """Returns the versions of the packages on which results depend, by name."""
    return {name: importlib.metadata.version(name) for name in _PACKAGES}


def machine() -> dict[str, object]:
    """Returns platform, version of Python, number of CPU cores and JAX's devices."""
    return {
        "platform": platform.platform(),
        "python": platform.python_version(),
        "cpu_cores": os.cpu_count(),
        "device": jax.devices()[0].device_kind,
        "num_devices": jax.device_count(),
    }
