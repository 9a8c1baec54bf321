"""Checks of a config's fields."""

from __future__ import annotations

import math


class ConfigError(ValueError):
    """A setting is wrong. The message names the setting, its value and the allowed values."""


def require(owner: object, name: str, is_valid: bool, allowed: str) -> None:
    """Raises a ConfigError that names the field, its value and the allowed values, unless the value is allowed.

    Args:
      owner: the dataclass that holds the field.
      name: name of the field.
      is_valid: whether the field's value is allowed.
      allowed: the allowed values in words, for the message.

    Raises:
      ConfigError: `is_valid` is false.
    """
    if not is_valid:
        value = getattr(owner, name)
        raise ConfigError(f"{type(owner).__name__}.{name} is {value!r}; allowed: {allowed}")


def require_positive(owner: object, *names: str) -> None:
    """Checks that the named fields of a dataclass are greater than 0 and finite.

    Args:
      owner: the dataclass that holds the fields.
      *names: names of the fields.

    Raises:
      ConfigError: a field is 0, negative, infinite or NaN.
    """
    for name in names:
        require(owner, name, 0 < getattr(owner, name) < math.inf, "greater than 0, finite")


def require_finite(owner: object, *names: str) -> None:
    """Checks that the named fields of a dataclass are finite numbers.

    Args:
      owner: the dataclass that holds the fields.
      *names: names of the fields.

    Raises:
      ConfigError: a field is infinite or NaN.
    """
    for name in names:
        require(owner, name, math.isfinite(getattr(owner, name)), "finite")


def require_unit(owner: object, *names: str) -> None:
    """Checks that the named fields of a dataclass lie between 0 and 1, both included.

    Args:
      owner: the dataclass that holds the fields.
      *names: names of the fields.

    Raises:
      ConfigError: a field is below 0, above 1 or NaN.
    """
    for name in names:
        require(owner, name, 0.0 <= getattr(owner, name) <= 1.0, "from 0 to 1")
