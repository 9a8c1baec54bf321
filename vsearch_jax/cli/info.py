"""Prints what a bug report needs: versions, devices, folders, and a self-test of the renderer."""

from __future__ import annotations

import importlib.metadata
import importlib.util
import platform
from importlib import resources

import jax

from vsearch_jax.cli import selftest
from vsearch_jax.scene.files import xml_folder

_PACKAGES = (
    "vsearch_jax",
    "jax",
    "jaxlib",
    "mujoco",
    "mujoco-mjx",
    "flax",
    "optax",
    "orbax-checkpoint",
    "brax",
    "evosax",
    "numpy",
)
_MODULE_OF_EXTRA = {"video": "imageio_ffmpeg"}
"""For each extra of the package a module that it installs."""


def print_info() -> bool:
    """Prints what a bug report needs (versions, devices, folders), then tests the renderer and prints the result.

    Returns:
      Whether the renderer works.
    """
    for label, value in describe_installation().items():
        print(f"{label + ':':<20} {value}", flush=True)
    try:
        difference = selftest.find_difference()
    except Exception as error:  # Any failure is a result of the test. The lines above help to find its cause.
        difference = _describe_error(error)
    print(f"{'renderer self-test:':<20} {'ok' if difference is None else difference}")
    return difference is None


def describe_installation() -> dict[str, str]:
    """Returns versions, devices, folders and installed extras for `vsearch info`, as {label: text}."""
    lines = {name: _version(name) for name in _PACKAGES}
    lines["Python"] = platform.python_version()
    lines["platform"] = platform.platform()
    lines["devices"] = _describe_devices()
    lines["compilation cache"] = str(jax.config.values["jax_compilation_cache_dir"] or "off")
    lines["package folder"] = str(resources.files("vsearch_jax"))
    lines["xml folder"] = str(xml_folder())
    for extra, module in _MODULE_OF_EXTRA.items():
        is_installed = importlib.util.find_spec(module) is not None
        missing = f"not installed; to install it: pip install 'vsearch_jax[{extra}]'"
        lines[f"extra {extra}"] = "installed" if is_installed else missing
    return lines


def _version(package: str) -> str:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return "not installed"


def _describe_devices() -> str:
    try:
        return ", ".join(f"{device} ({device.device_kind})" for device in jax.devices())
    except Exception as error:  # JAX raises several types if JAX_PLATFORMS names a missing platform.
        return f"none ({_describe_error(error)})"


def _describe_error(error: Exception) -> str:
    """Returns type and message in one line."""
    return " ".join(f"{type(error).__name__}: {error}".split())
