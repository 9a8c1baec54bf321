"""The `vsearch` command. What is slow to import is imported when a subcommand runs, so that --help comes at once."""

from __future__ import annotations

import contextlib
import dataclasses
import io
import itertools
import os
import re
import signal
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Any, Union

import tyro
from rich.console import Console

from vsearch_jax.cli.commands import DEFAULT_PRESET, Command, Eval, Export, Reach, Train, Video
from vsearch_jax.config import Config, ConfigError, SceneConfig
from vsearch_jax.runs.atomic import write_atomically
from vsearch_jax.runs.folder import RunError, check_new_file, lock_folder, make_new_folder, read_config, read_seed

INTERRUPTED = 130
"""Exit status after Ctrl-C, as shells have it: 128 + SIGINT."""


class UsageError(ValueError):
    """The command line can't be understood."""


def parse(arguments: Sequence[str]) -> Command:
    """Returns the command that `arguments` spell; prints help and exits where they ask for it.

    Raises:
      UsageError: an argument is unknown, missing, or no value of its type.
      ConfigError: a value is out of its range, or no preset has that name.
      RunError: --resume, and --out holds no run.
    """
    train = Train(out=tyro.MISSING)
    if list(arguments[:1]) == ["train"]:
        train = dataclasses.replace(train, config=_starting_config(arguments[1:]))
    # tyro reads the defaults, and so --help, from an instance.
    command_type: Any = Union[  # noqa: UP007 # built from values, which the newer form can't be
        Annotated[Train, tyro.conf.subcommand("train", default=train)],
        Annotated[Eval, tyro.conf.subcommand("eval")],
        Annotated[Export, tyro.conf.subcommand("export")],
        Annotated[Reach, tyro.conf.subcommand("reach")],
        Annotated[Video, tyro.conf.subcommand("video")],
    ]
    errors = io.StringIO()
    try:
        with contextlib.redirect_stderr(errors):
            command = tyro.cli(
                command_type,
                prog="vsearch",
                description="View search in JAX: train, evaluate, export, reach, video.",
                args=arguments,
            )
    except SystemExit as exit_:
        if not exit_.code:
            raise  # after --help
        raise UsageError(_one_line(errors.getvalue())) from None
    return _with_shortcuts(command) if isinstance(command, Train) else command


def _starting_config(arguments: Sequence[str]) -> Config:
    """Returns the config that the other options of `train` change: of the preset, or of the run that is to go on."""
    preset, out = _value_of("--preset", arguments), _value_of("--out", arguments)
    if preset is None and out is not None and "--resume" in arguments:
        return read_config(Path(out))
    return Config.preset(preset or DEFAULT_PRESET)


def _value_of(option: str, arguments: Sequence[str]) -> str | None:
    value = None
    for i, argument in enumerate(arguments):
        if argument == option:
            value = next(iter(arguments[i + 1 :]), None)
        elif argument.startswith(f"{option}="):
            value = argument.partition("=")[2]
    return value  # of the last one, as tyro has it


def _with_shortcuts(command: Train) -> Train:
    scene, encoder = command.config.scene, command.config.encoder
    scene = dataclasses.replace(
        scene,
        object=_absolute(command.object or scene.object),
        arm=_absolute(command.arm or scene.arm),
        obstacles=scene.obstacles and _absolute(scene.obstacles),
    )
    encoder = dataclasses.replace(encoder, input=command.input or encoder.input)
    return dataclasses.replace(command, config=dataclasses.replace(command.config, scene=scene, encoder=encoder))


def _absolute(name: str) -> str:
    """Returns a path made absolute, since a run may go on from another folder; a plain name as it is."""
    path = Path(os.path.expanduser(name))  # which leaves the home of an unknown user as it is
    return str(path.resolve()) if path.suffix or path.parent != Path(".") else name


def _one_line(box: str) -> str:
    """Returns the message in one of tyro's boxes, without its frame and the help below its first rule."""
    # Where the terminal's encoding is not UTF-8 the frame is of spaces and the rules are of hyphens.
    lines = [line.strip(" │╭╮╰╯─") for line in box.splitlines()]
    below_title = itertools.dropwhile(lambda line: not line.strip("-"), lines[1:])
    message = " ".join(itertools.takewhile(lambda line: line.strip("-"), below_title))
    # tyro names the field of a nested config by a name of its own; ours is in the message.
    return re.sub(r"Error parsing __tyro\S*: ", "", message)


def run_train(command: Train) -> None:
    """Runs `vsearch train`."""
    loop = _import_loop()
    from vsearch_jax.cli.progress import training_progress

    console, config, run = Console(), command.config, command.out
    if not command.resume:
        make_new_folder(run)
    with lock_folder(run):
        with console.status("building the scene, mapping what the arm can reach"):
            state = _resume(command) if command.resume else _start(command)
        with training_progress(console, config, int(state.step)) as progress:
            state = loop.train_to_end(run, state, config, progress.update, progress.stopping)
        _evaluate(run, state, config, console)


def _start(command: Train) -> Any:
    """Starts the run; where the arm reaches too little, leaves a picture of what it does reach beside the folder."""
    loop = _import_loop()
    from vsearch_jax.env import UnreachableError

    try:
        return loop.start_run(command.out, command.config, command.seed or 0)
    except UnreachableError as error:
        from vsearch_jax import report

        picture = command.out.with_name(f"{command.out.name}-reachability.png")
        try:
            write_atomically(picture, report.to_png(report.reachability(error.reach)))
        except OSError:  # the disk is full: what is wrong with the config counts more
            raise error from None
        raise ConfigError(f"{error}; {picture} shows what it reaches") from None


def _resume(command: Train) -> Any:
    if command.seed is not None and command.seed != read_seed(command.out):
        raise RunError(
            f"the run in {command.out} has seed {read_seed(command.out)}; leave --seed out to go on with it, or name "
            "another folder with --out"
        )
    return _import_loop().resume_run(command.out, command.config)


def run_eval(command: Eval) -> None:
    """Runs `vsearch eval`."""
    loop = _import_loop()
    console, trained = Console(), read_config(command.run)
    config = _with_motion(command, trained)
    if command.out is None and config != trained:
        raise RunError(
            f"{command.run} was trained with env.reachable {trained.env.reachable} and env.motion "
            f"{trained.env.motion}; name a folder for the results of another evaluation with --out"
        )
    with lock_folder(command.run):
        with console.status("reading the run"):
            state = loop.resume_run(command.run, trained)
        loop.check_finished(command.run, state, trained)
        if command.out is not None:
            make_new_folder(command.out)
        _evaluate(command.run, state, config, console, command.out)


def _with_motion(command: Eval, config: Config) -> Config:
    motion = command.motion or config.env.motion
    reachable = command.reachable or ("path" if motion == "dynamic" else config.env.reachable)
    return dataclasses.replace(config, env=dataclasses.replace(config.env, motion=motion, reachable=reachable))


def _evaluate(run: Path, state: Any, config: Config, console: Console, out: Path | None = None) -> None:
    loop = _import_loop()
    from vsearch_jax import report

    out = run if out is None else out
    with console.status("evaluating every searcher"):
        summary = report.write_report(out, loop.evaluate_run(run, state, config), config)
    report.print_table(summary, console)
    console.print(f"report: {out / 'report.html'}", highlight=False, soft_wrap=True)


def run_export(command: Export) -> None:
    """Runs `vsearch export`."""
    loop = _import_loop()
    from vsearch_jax.export import stablehlo

    config = read_config(command.run)
    state = loop.resume_run(command.run, config)
    loop.check_finished(command.run, state, config)
    make_new_folder(command.out)
    stablehlo.export(command.out, state, config, command.seed)
    print(f"wrote {command.out}: encoder.stablehlo, policy.stablehlo, interface.json")


def run_reach(command: Reach) -> None:
    """Runs `vsearch reach`."""
    _import_loop()
    from vsearch_jax.cli.reach import draw_reach

    scene = SceneConfig(
        arm=_absolute(command.arm),
        object=_absolute(command.object),
        obstacles=None if command.obstacles is None else _absolute(command.obstacles),
        radius=command.radius,
        center_height=command.center_height,
        mesh_scale=command.mesh_scale,
    )
    make_new_folder(command.out)
    with Console().status("mapping what the arm reaches"):
        message = draw_reach(command.out, scene, command.band, command.heights)
    print(message)


def run_video(command: Video) -> None:
    """Runs `vsearch video`."""
    loop = _import_loop()
    from vsearch_jax.film.video import make_video

    config = read_config(command.run)
    state = loop.resume_run(command.run, config)
    loop.check_finished(command.run, state, config)
    check_new_file(command.out, ".mp4")
    with Console().status("filming a search"):
        message = make_video(command.out, state, config, command.motion, command.seed)
    print(message)


def _import_loop() -> Any:
    # mjx prints on import that Warp is missing, which nothing here needs.
    with contextlib.redirect_stdout(io.StringIO()):
        from vsearch_jax.runs import loop
    return loop


_RUN: dict[type, Callable[[Any], None]] = {
    Train: run_train,
    Eval: run_eval,
    Export: run_export,
    Reach: run_reach,
    Video: run_video,
}


def main(arguments: Sequence[str] | None = None) -> None:
    """Runs the command line and exits: 0 when done, 2 after an error of the user's, 130 when interrupted."""
    for number in (signal.SIGTERM, signal.SIGINT):  # shells start background jobs with SIGINT ignored
        signal.signal(number, signal.default_int_handler)
    command = None
    try:
        command = parse(sys.argv[1:] if arguments is None else arguments)
        _RUN[type(command)](command)
    except KeyboardInterrupt:
        print(f"\nvsearch: {_interrupted(command)}", file=sys.stderr)
        sys.stdout.flush()
        sys.stderr.flush()
        # A computation may still run in its thread, and the interpreter would wait for it.
        os._exit(INTERRUPTED)
    except (ValueError, OSError) as error:
        if not isinstance(error, OSError) and not type(error).__module__.startswith("vsearch_jax."):
            raise  # our own errors tell users what to do; any other ValueError is a fault of ours
        print(f"vsearch: error: {_describe(error, command)}", file=sys.stderr)
        sys.exit(2)


def _describe(error: Exception, command: Command | None) -> str:
    if isinstance(error, OSError) and error.errno is not None and error.filename is None:
        # The system says what, but not where: it is a write into the folder of the command, on a full disk for example.
        folder = getattr(command, "out", None) or getattr(command, "run", None)
        return f"cannot write to {folder}: {error.strerror}"
    return str(error)


def _interrupted(command: Command | None) -> str:
    from vsearch_jax.runs.checkpoint import latest_step

    if not isinstance(command, Train):
        return "interrupted"
    step = latest_step(command.out)
    if step is None:
        return "interrupted before anything was saved; give the same command to start again"
    return f"interrupted; {step} iterations are saved. Go on with: vsearch train --out {command.out} --resume"
