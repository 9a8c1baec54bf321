"""Reads nested plain values, for instance from JSON, into dataclasses."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import TYPE_CHECKING, Literal, TypeVar, get_args, get_origin, get_type_hints

from vsearch_jax.config.validation import ConfigError

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

Parsed = TypeVar("Parsed", bound="DataclassInstance")


def parse_dataclass(cls: type[Parsed], values: Mapping[str, object]) -> Parsed:
    """Builds a dataclass from nested plain values, for instance from JSON.

    A list becomes a tuple. A mapping becomes the dataclass that the field's type names.

    Args:
      cls: the dataclass to build.
      values: value of each field, by the field's name.

    Raises:
      ConfigError: a field is unknown or missing, or its value has another type or is out of range.
    """
    fields = {f.name: f for f in dataclasses.fields(cls)}
    unknown, missing = sorted(set(values) - set(fields)), sorted(set(fields) - set(values))
    if unknown or missing:
        raise ConfigError(
            f"{cls.__name__}: unknown fields {unknown}, missing fields {missing}; expected {sorted(fields)}"
        )
    hints = get_type_hints(cls)
    return cls(**{name: _parse_value(f"{cls.__name__}.{name}", hints[name], values[name]) for name in fields})


def _parse_value(name: str, hint: type, raw: object) -> object:
    """Returns the value of the field `name` ("Class.field"), whose type is `hint`."""
    value = tuple(raw) if isinstance(raw, list) else raw
    if dataclasses.is_dataclass(hint) and isinstance(value, dict):
        return parse_dataclass(hint, value)
    if not _has_type(value, hint):
        allowed = str(hint).replace("typing.", "") if get_args(hint) else hint.__name__
        raise ConfigError(f"{name} is {value!r}; allowed: {allowed}")
    return value


def _has_type(value: object, hint: type) -> bool:
    """Returns whether `value` has the type `hint`. Only types that a config's fields have are supported."""
    arguments = get_args(hint)
    if get_origin(hint) is Literal:
        return value in arguments
    if get_origin(hint) is tuple:
        return isinstance(value, tuple) and all(_has_type(entry, arguments[0]) for entry in value)
    if arguments:  # a union
        return any(_has_type(value, argument) for argument in arguments)
    allowed = (int, float) if hint is float else hint
    return isinstance(value, allowed) and (hint is bool or not isinstance(value, bool))
