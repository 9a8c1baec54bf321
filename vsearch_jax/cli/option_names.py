"""Translates names of config fields and of arguments in error messages into names of command-line options.

The Python API reports the field SceneConfig.mount_height, and the argument `seed` in backquotes. Users of
`vsearch train` know the options --scene.mount-height and --seed.
"""

from __future__ import annotations

import dataclasses
import functools
import re
from typing import get_type_hints

from vsearch_jax.cli.commands import Command, Train
from vsearch_jax.config import Config

# A field with or without its class or section, outside of paths and quoted text.
_NAME = re.compile(r"(?<![\w./'\"-])(?:[A-Za-z]\w*\.)?[a-z]\w*(?![\w/'\"-])")

# An argument of a Python function, in backquotes.
_ARGUMENT = re.compile(r"`(\w+)`")
_OPTION_OF_ARGUMENT = {
    "episode": "episode",
    "folder": "out",
    "path": "out",
    "policy": "policy",
    "preset": "preset",
    "seed": "seed",
}
"""For each argument that error messages name: the field of the subcommand whose value it gets."""
_SHORTCUTS = {("scene", "arm"): "arm", ("scene", "object"): "object", ("encoder", "input"): "input"}
"""Fields of a config, as (section, field), for which `train` has a short option."""


def use_option_names(message: str, command_type: type[Command]) -> str:
    """Replaces config fields and arguments in an error message by command-line options, such as `--scene.mount-height`.

    Three spellings of a field are replaced: `SceneConfig.mount_height`, `scene.mount_height`, and `mount_height` alone.
    A name alone is replaced only if it has an underscore, so that ordinary words stay. It must also stand for one field
    only. The name of an argument is replaced if it is in backquotes. A name without an option is not replaced.

    Args:
      message: the message of an error.
      command_type: the subcommand that the user gave; only options of this subcommand are named.

    Returns:
      The message with names of options.
    """
    options: dict[str, str] = {}
    options_of_word: dict[str, set[str]] = {}
    for section, section_type in _sections().items():
        is_named = f"{section_type.__name__}." in message
        for field in (field.name for field in dataclasses.fields(section_type) if field.name not in _sections()):
            option = _option(section, field, command_type)
            if option is None:
                continue
            options[f"{section_type.__name__}.{field}"] = option
            options[f"{section}.{field}"] = option
            if "_" in field:
                options_of_word.setdefault(field, set()).add(option)
                if is_named:  # This class is meant, even if other classes have a field of this name.
                    options[field] = option
    unique = {word: next(iter(found)) for word, found in options_of_word.items() if len(found) == 1}
    names = unique | options
    message = _NAME.sub(lambda match: names.get(match.group(), match.group()), message)
    return _ARGUMENT.sub(lambda match: _option_of_argument(match.group(1), command_type) or match.group(), message)


@functools.cache
def _sections() -> dict[str, type]:
    """Returns the dataclasses of a config by their field in Config; "" for Config itself."""
    hints = get_type_hints(Config)
    sections = {name: hint for name, hint in hints.items() if isinstance(hint, type) and dataclasses.is_dataclass(hint)}
    return {"": Config, **sections}


def _option(section: str, field: str, command_type: type[Command]) -> str | None:
    """Returns the option that sets a field, None if the command has none."""
    if command_type is not Train:
        return _own_option(field, command_type)
    name = _SHORTCUTS.get((section, field), f"{section}.{field}" if section else field)
    return _to_option(name)


def _option_of_argument(argument: str, command_type: type[Command]) -> str | None:
    """Returns the option that gives the value of an argument, None if the command has none."""
    return _own_option(_OPTION_OF_ARGUMENT.get(argument, ""), command_type)


def _own_option(name: str, command_type: type[Command]) -> str | None:
    """Returns the option of a field of the command itself, None if the command has no such field."""
    return _to_option(name) if name in {field.name for field in dataclasses.fields(command_type)} else None


def _to_option(name: str) -> str:
    return f"--{name.replace('_', '-')}"
