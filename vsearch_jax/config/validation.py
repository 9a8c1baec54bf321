"""Checks of fields, with messages that name field, value and range."""

from __future__ import annotations

import math


class ConfigError(ValueError):
    """A field of the config is out of its range; the message names field, value and range."""


def require(owner: object, name: str, is_valid: bool, allowed: str) -> None:
    """Raises ConfigError where field `name` of `owner` is not valid; `allowed` says what would be."""
    if not is_valid:
        value = getattr(owner, name)
        raise ConfigError(f"{type(owner).__name__}.{name} is {value!r}; allowed: {allowed}")


def require_positive(owner: object, *names: str) -> None:
    """Raises ConfigError where one of the fields `names` of `owner` is not above 0."""
    for name in names:
        require(owner, name, 0 < getattr(owner, name) < math.inf, "greater than 0, finite")


def require_finite(owner: object, *names: str) -> None:
    """Raises ConfigError where one of the fields `names` of `owner` is not a finite number."""
    for name in names:
        require(owner, name, math.isfinite(getattr(owner, name)), "finite")


def require_unit(owner: object, *names: str) -> None:
    """Raises ConfigError where one of the fields `names` of `owner` is not from 0 to 1."""
    for name in names:
        require(owner, name, 0.0 <= getattr(owner, name) <= 1.0, "from 0 to 1")
