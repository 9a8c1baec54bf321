"""Parses the command line. Does not import JAX, so that --help is fast."""

from __future__ import annotations

import contextlib
import dataclasses
import importlib.metadata
import io
import itertools
import os
import re
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TypeVar, cast

import tyro

from vsearch_jax.cli.commands import COMMANDS, DEFAULT_PRESET, Command, Train
from vsearch_jax.config import Config
from vsearch_jax.runs.folder import read_config

Parsed = TypeVar("Parsed")


class UsageError(ValueError):
    """An argument of the command line is unknown, missing or not a value of its type."""


def parse(arguments: Sequence[str]) -> Command:
    """Parses the command line of `vsearch` into a subcommand with its options. --help prints help and exits.

    Args:
      arguments: the command line, without the name of the program.

    Returns:
      The subcommand that the user gave, with the values of all options.

    Raises:
      UsageError: an argument is unknown, missing or not a value of its type.
      ConfigError: a value is out of range, or no preset has the given name.
      RunError: --resume is given, and --out holds no run.
    """
    name, *rest = arguments or [""]
    if name == "--version":
        print(f"vsearch_jax {importlib.metadata.version('vsearch_jax')}")
        sys.exit()
    for before, argument in itertools.pairwise([name, *rest]):
        if argument == "" or re.fullmatch(r"--[\w.-]+=", argument):
            option = argument.rstrip("=") or before
            raise UsageError(f"the value of {option} is empty; give a value, or leave the option out")
    if name == "train":
        default = Train(out=tyro.MISSING, config=_starting_config(rest))
        return _expand_home(_apply_shortcuts(_parse_as(Train, rest, f"vsearch {name}", default)))
    if name in COMMANDS:
        return _expand_home(_parse_as(COMMANDS[name], rest, f"vsearch {name}"))
    if name and not name.startswith("-"):
        raise UsageError(f"unknown command {name!r}; allowed: {', '.join(COMMANDS)}")
    # Prints the help or raises, since no subcommand comes first. tyro accepts a union in place of a type.
    return _parse_as(cast(type[Command], Command), arguments, "vsearch")


def _parse_as(
    command_type: type[Parsed], arguments: Sequence[str], program: str, default: Parsed | None = None
) -> Parsed:
    """Parses arguments into a dataclass. Turns tyro's error box into one line.

    Args:
      command_type: the dataclass, or a union of them, which become subcommands.
      arguments: the arguments.
      program: name of the program in the help.
      default: default values.
    """
    errors = io.StringIO()
    description = "View search in JAX: finds the view that a target image shows." if command_type is Command else None
    try:
        with contextlib.redirect_stderr(errors):
            return tyro.cli(
                command_type,
                prog=program,
                description=description,
                args=arguments,
                default=tyro.MISSING_NONPROP if default is None else default,
            )
    except SystemExit as exit_:
        if not exit_.code:
            raise  # after --help
        raise UsageError(_error_line(errors.getvalue())) from None


def _starting_config(arguments: Sequence[str]) -> Config:
    """Returns the config that the options of `train` change: the preset's, or with --resume the run's."""
    preset, out = _option_value("--preset", arguments), _option_value("--out", arguments)
    if preset is None and out is not None and "--resume" in arguments:
        return read_config(Path(os.path.expanduser(out)))
    return Config.preset(preset or DEFAULT_PRESET)


def _option_value(option: str, arguments: Sequence[str]) -> str | None:
    """Returns the value of an option, None if it is not given. The last value counts, as in tyro."""
    value = None
    for i, argument in enumerate(arguments):
        if argument == option:
            value = next(iter(arguments[i + 1 :]), None)
        elif argument.startswith(f"{option}="):
            value = argument.partition("=")[2]
    return value


def _expand_home(command: Command) -> Command:
    """Returns the command with `~` at the start of its paths replaced. Shells leave it in `--out=~/run`."""
    values = {field.name: getattr(command, field.name) for field in dataclasses.fields(command)}
    paths = {name: value for name, value in values.items() if isinstance(value, Path)}
    return dataclasses.replace(command, **{name: Path(os.path.expanduser(path)) for name, path in paths.items()})


def _apply_shortcuts(command: Train) -> Train:
    """Returns the command with --object, --arm and --input written into its config."""
    scene, encoder = command.config.scene, command.config.encoder
    scene = dataclasses.replace(
        scene,
        object=absolute_path(command.object or scene.object),
        arm=absolute_path(command.arm or scene.arm),
        obstacles=scene.obstacles and absolute_path(scene.obstacles),
    )
    encoder = dataclasses.replace(encoder, input=command.input or encoder.input)
    return dataclasses.replace(command, config=dataclasses.replace(command.config, scene=scene, encoder=encoder))


def absolute_path(name: str) -> str:
    """Makes the value of an option absolute if it is a path. A plain name, such as "teapot", is returned unchanged.

    A run can be resumed from another working folder, so the config must not hold relative paths.
    """
    path = Path(os.path.expanduser(name))  # Path.expanduser raises if the user is unknown; this function does not.
    return str(path.resolve()) if path.suffix or path.parent != Path(".") else name


def _error_line(box: str) -> str:
    """Returns the message in tyro's error box, without the frame and without the help below the first rule."""
    # If the terminal's encoding is not UTF-8, the frame is made of spaces and the rules of hyphens.
    lines = [line.strip(" │╭╮╰╯─") for line in box.splitlines()]
    below_title = itertools.dropwhile(lambda line: not line.strip("-"), lines[1:])
    message = " ".join(itertools.takewhile(lambda line: line.strip("-"), below_title))
    # tyro prefixes the message of a ConfigError with a name of its own. The message names the field.
    return re.sub(r"Error parsing (?!-)\S+: ", "", message)
