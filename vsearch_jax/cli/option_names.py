"""Translates names of config fields in error messages into names of command-line options.

The Python API reports `SceneConfig.mount_height`. Users of `vsearch train` know the option `--scene.mount-height`.
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


def use_option_names(message: str, command_type: type[Command]) -> str:
    """Replaces names of config fields in an error message by command-line options, such as `--scene.mount-height`.

    Three spellings are replaced: `SceneConfig.mount_height`, `scene.mount_height`, and `mount_height` alone. A name
    alone is replaced only if it has an underscore, so that ordinary words stay. It must also stand for one field only.
    A field without an option is not replaced.

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
    return _NAME.sub(lambda match: names.get(match.group(), match.group()), message)


@functools.cache
def _sections() -> dict[str, type]:
    """Returns the dataclasses of a config by their field in Config; "" for Config itself."""
    hints = get_type_hints(Config)
    sections = {name: hint for name, hint in hints.items() if isinstance(hint, type) and dataclasses.is_dataclass(hint)}
    return {"": Config, **sections}


def _option(section: str, field: str, command_type: type[Command]) -> str | None:
    """Returns the option that sets a field, None if the command has none."""
    if command_type is Train:
        name = f"{section}.{field}" if section else field
    elif field in {own.name for own in dataclasses.fields(command_type)}:
        name = field
    else:
        return None
    return f"--{name.replace('_', '-')}"
