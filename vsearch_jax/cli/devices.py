"""Checks of JAX before a command computes."""

from __future__ import annotations

import jax


class DeviceError(ValueError):
    """JAX finds no device. The message names the remedy."""


def check_devices() -> None:
    """Checks that JAX finds a device to compute on.

    Raises:
      DeviceError: it finds none, for example because JAX_PLATFORMS names a platform that is missing.
    """
    try:
        jax.devices()
    except Exception as error:  # JAX raises several types if JAX_PLATFORMS names a missing platform.
        reason = " ".join(str(error).split())  # empty for a missing CUDA plugin
        raise DeviceError(
            f"JAX finds no device{f': {reason}' if reason else ''}; set JAX_PLATFORMS=cpu, or install JAX for the "
            "platform that JAX_PLATFORMS names"
        ) from error
