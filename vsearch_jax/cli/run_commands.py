"""Runs the subcommands of `vsearch` that need JAX."""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
import os
from pathlib import Path

from rich.console import Console

from vsearch_jax import film, report
from vsearch_jax.cli.commands import Eval, Export, Reach, Train, Video
from vsearch_jax.cli.parse import absolute_path
from vsearch_jax.cli.progress import show_status, training_progress
from vsearch_jax.cli.reach import draw_reach
from vsearch_jax.config import Config, ConfigError, SceneConfig
from vsearch_jax.env import UnreachableError, check_jax_settings
from vsearch_jax.export import stablehlo
from vsearch_jax.runs import loop
from vsearch_jax.runs.atomic import write_atomically
from vsearch_jax.runs.folder import RunError, lock_folder, new_file, new_folder, read_config, read_seed
from vsearch_jax.scene import describe_symmetry, object_symmetry
from vsearch_jax.types import TrainState


def run_command(command: Train | Eval | Export | Reach | Video) -> None:
    """Runs one of the subcommands of `vsearch` that need JAX, with the options that the user gave.

    Raises:
      ValueError: a subclass that this package defines; its message names the cause and the remedy.
      OSError: the disk is full or not writable.
      KeyboardInterrupt: a signal stopped the command.
    """
    check_jax_settings()
    match command:
        case Train():
            _train(command)
        case Eval():
            _evaluate_again(command)
        case Export():
            _export(command)
        case Reach():
            _reach(command)
        case Video():
            _film(command)


def _train(command: Train) -> None:
    console, config, run = Console(), command.config, command.out
    made = contextlib.nullcontext() if command.resume else new_folder(run)
    with made, lock_folder(run):
        with show_status(console, "building the scene, computing what the arm reaches"):
            state = _resume(command) if command.resume else _start(command)
        if sentence := describe_symmetry(object_symmetry(config.scene)):
            console.print(sentence, highlight=False, soft_wrap=True)
        with training_progress(console, config, int(state.step)) as progress:
            state = loop.train_to_end(run, state, config, progress.update, progress.announce_stop)
        _evaluate(run, state, config, console, out=run)


def _start(command: Train) -> TrainState:
    """Starts the run. If the arm reaches too little, draws what it reaches into a file beside the folder."""
    try:
        return loop.start_run(command.out, command.config, command.seed or 0)
    except UnreachableError as error:
        figure = _unused_path(f"{os.path.abspath(command.out)}-reachability")
        try:
            write_atomically(figure, report.to_png(report.draw_reachability(error.reach)))
        except OSError:  # A full disk matters less to the user than the error in the config.
            raise error from None
        raise ConfigError(f"{error}; {figure} shows what it reaches") from None


def _unused_path(stem: str) -> Path:
    """Returns the path of a PNG file that does not exist yet: the stem, with a number if the stem alone is in use."""
    names = itertools.chain([f"{stem}.png"], (f"{stem}-{number}.png" for number in itertools.count(2)))
    return next(Path(name) for name in names if not os.path.lexists(name))


def _resume(command: Train) -> TrainState:
    if command.seed is not None and command.seed != read_seed(command.out):
        raise RunError(
            f"the run in {command.out} has seed {read_seed(command.out)}; leave --seed out to resume it, or name "
            "another folder with --out"
        )
    return loop.resume_run(command.out, command.config)


def _evaluate_again(command: Eval) -> None:
    console, trained = Console(), read_config(command.run)
    config = _with_motion(command, trained)
    if command.out is None and config != trained:
        raise RunError(
            f"{command.run} was trained with env.reachable {trained.env.reachable} and env.motion "
            f"{trained.env.motion}; name a folder for the results of another evaluation with --out"
        )
    with lock_folder(command.run):
        with show_status(console, "reading the run"):
            state = _finished_state(command.run, trained)
        with contextlib.nullcontext() if command.out is None else new_folder(command.out):
            _evaluate(command.run, state, config, console, out=command.out or command.run)


def _with_motion(command: Eval, config: Config) -> Config:
    """Returns the run's config with --motion and --reachable applied."""
    motion = command.motion or config.env.motion
    reachable = command.reachable or ("path" if motion == "dynamic" else config.env.reachable)
    return dataclasses.replace(config, env=dataclasses.replace(config.env, motion=motion, reachable=reachable))


def _evaluate(run: Path, state: TrainState, config: Config, console: Console, *, out: Path) -> None:
    """Evaluates a run, writes its report into `out` and prints the table."""
    with show_status(console, "evaluating every searcher"):
        summary = report.write_report(out, loop.evaluate_run(run, state, config), config)
    report.print_table(summary, console)
    if sentence := describe_symmetry(summary["symmetry"]):
        console.print(sentence, highlight=False, soft_wrap=True)
    # A path may hold brackets or colons, which rich would take for markup or emoji.
    console.print(f"report: {out / 'report.html'}", highlight=False, soft_wrap=True, markup=False, emoji=False)
    if (warning := report.false_positive_warning(summary)) is not None:
        console.print(warning, style="bold red", highlight=False, soft_wrap=True)


def _finished_state(run: Path, config: Config) -> TrainState:
    """Loads the last state of a run, which must be finished."""
    state = loop.resume_run(run, config)
    loop.check_finished(run, state, config)
    return state


def _export(command: Export) -> None:
    config = read_config(command.run)
    state = _finished_state(command.run, config)
    with new_folder(command.out):
        stablehlo.export(command.out, state, config, command.policy)
    print(f"wrote {command.out}: encoder.stablehlo, policy.stablehlo, interface.json")


def _reach(command: Reach) -> None:
    scene = SceneConfig(
        arm=absolute_path(command.arm),
        object=absolute_path(command.object),
        obstacles=None if command.obstacles is None else absolute_path(command.obstacles),
        radius=command.radius,
        center_height=command.center_height,
        mesh_scale=command.mesh_scale,
        mesh_up=command.mesh_up,
    )
    with new_folder(command.out), show_status(Console(), "computing what the arm reaches"):
        message = draw_reach(command.out, scene, command.band, command.heights)
    print(message)


def _film(command: Video) -> None:
    config = read_config(command.run)
    state = _finished_state(command.run, config)
    with new_file(command.out, ".mp4"), show_status(Console(), "filming a search"):
        message = film.make_film(command.out, state, config, command.motion, command.episode)
    print(message)
