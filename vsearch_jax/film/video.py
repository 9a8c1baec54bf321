"""A film of one search by the policy of a finished run."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from pathlib import Path
from typing import Literal, NamedTuple

import jax
import numpy as np

from vsearch_jax.config import Config, ConfigError
from vsearch_jax.film.motions import FPS, MOST_SECONDS, FilmedSearch, Frames, film_search, look_along
from vsearch_jax.film.overview import overview_camera
from vsearch_jax.film.page import FilmPage, Moment
from vsearch_jax.film.writer import FilmError, find_ffmpeg, write_film
from vsearch_jax.runs.folder import MAX_SEED
from vsearch_jax.runs.interrupts import call_interruptibly
from vsearch_jax.scene import build_scene
from vsearch_jax.types import TrainState

HEIGHT = 720
"""Of the film, in pixels; it is 16/9 of that wide."""
HOLD_SECONDS, END_SECONDS = 0.6, 2.5
"""How long the film stands at each view whose picture is taken, and at the last."""
_BELOW = 0.25
"""How far below the lowest cosine of a picture taken the curve's axis goes: on the way it may be lower."""
_CHUNK = 32
"""Frames that are in memory at a time."""


class _Plan(NamedTuple):
    """The frames of a film; N is their number, holds not counted.

    Attributes:
      qpos: f32[N, nq] rad or m.
      steps: i32[N], the step of the search that a frame is part of; 0 is the start.
      is_taken: bool[N], the policy looks at the frame's wrist picture.
    """

    qpos: np.ndarray
    steps: np.ndarray
    is_taken: np.ndarray


def make_video(
    out: Path,
    state: TrainState,
    config: Config,
    motion: Literal["dynamic", "kinematic"],
    seed: int | None,
    height: int = HEIGHT,
) -> str:
    """Films one search by the first policy of a run and returns a line to tell.

    The arm's motions are in real time; the film stands a while at each view whose picture is taken.

    Args:
      out: the file, ending in .mp4.
      state: of a finished run.
      config: the run's.
      motion: the arm as its dynamics move it, or exactly on the planned paths.
      seed: of a random initial view and target; None for the search that the run's report shows.
      height: of the film, in pixels; a multiple of 18, so that its width is a whole, even number.

    Raises:
      ConfigError: the seed is out of range.
      PlanningError, SceneError: the arm's model has no speed limits, or no actuators for dynamic motion.
      FilmError: a motion is too long for a film, or the encoder stopped, as it does on a full disk.
    """
    if seed is not None and not 0 <= seed <= MAX_SEED:
        raise ConfigError(f"seed is {seed}; allowed: 0 to {MAX_SEED}")
    find_ffmpeg()  # now, not when the search is done
    config = dataclasses.replace(config, env=dataclasses.replace(config.env, reachable="path", motion=motion))
    key = None if seed is None else jax.random.key(seed)
    search: FilmedSearch = jax.tree.map(np.asarray, call_interruptibly(film_search, state, key, config))
    longest = float(search.seconds.max())
    if longest > MOST_SECONDS:
        raise FilmError(
            f"a motion takes {longest:.0f} s and a film holds {MOST_SECONDS} s of each at most; film another search "
            "with --seed, or raise the speeds (`user` of the joints) in the arm's file"
        )
    plan = _plan(search)
    frames = _frames(state, search, plan, config, height)
    num_frames = write_film(out, frames, FPS, (height, height * 16 // 9))
    ending = "found" if search.is_found else "not found"
    return f"wrote {out}: {num_frames / FPS:.1f} s, the target is {ending} after {int(search.num_steps)} steps"


def _plan(search: FilmedSearch) -> _Plan:
    counts = np.maximum(np.ceil(search.seconds * FPS), 1).astype(int)[: int(search.num_steps)]
    motions = [joints[:count] for joints, count in zip(search.joints, counts, strict=False)]
    is_taken = np.zeros(1 + counts.sum(), bool)
    is_taken[np.cumsum([0, *counts])] = True
    steps = np.repeat(np.arange(1 + len(counts)), [1, *counts])
    return _Plan(np.concatenate([search.start[None], *motions]), steps, is_taken)


def _frames(state: TrainState, search: FilmedSearch, plan: _Plan, config: Config, height: int) -> Iterator[np.ndarray]:
    """Yields the film's frames, u8[H, W, 3]."""
    last = len(plan.qpos) - 1
    target_picture, pictures = _pictures(state, search, plan, config, height)
    lowest = max(float(search.similarity.min()) - _BELOW, -1.05)
    page = FilmPage(target_picture, (max(last, 1) / FPS, lowest), config.env.threshold, height)
    for number, seen in enumerate(pictures):
        moment = Moment(
            overview=np.asarray(seen.overview),
            wrist=np.asarray(seen.wrist),
            time=number / FPS,
            similarity=float(seen.similarity),
            view_deg=(float(np.rad2deg(seen.view.azimuth)) % 360.0, float(np.rad2deg(seen.view.elevation))),
            caption=_caption(search, int(plan.steps[number]), bool(plan.is_taken[number])),
            is_taken=bool(plan.is_taken[number]),
        )
        hold = (END_SECONDS if number == last else HOLD_SECONDS) if moment.is_taken else 0.0
        frame = page.draw(moment)
        for _ in range(1 + round(hold * FPS)):
            yield frame


def _caption(search: FilmedSearch, step: int, is_taken: bool) -> str:
    if step == 0:
        return "start"
    name = f"step {step}"
    if not search.is_reachable[step - 1]:
        return f"{name}: out of reach, the arm stays"
    if not is_taken:
        return name
    if step < search.num_steps:
        return f"{name}: a picture is taken"
    return f"{name}: found" if search.is_found else f"{name}: not found, the steps are used up"


def _pictures(
    state: TrainState, search: FilmedSearch, plan: _Plan, config: Config, height: int
) -> tuple[np.ndarray, Iterator[Frames]]:
    """Returns the target picture u8[h, h, 3] and, one by one, what is seen in each frame."""
    size = (height, height * 8 // 9)
    # The target's picture is one more frame, so that nothing is compiled for it alone.
    qpos = np.concatenate([search.target.qpos[None], plan.qpos])
    camera = overview_camera(build_scene(config.scene), plan.qpos, size)

    def looks() -> Iterator[Frames]:
        for first in range(0, len(qpos), _CHUNK):
            index = np.minimum(np.arange(first, first + _CHUNK), len(qpos) - 1)
            seen = call_interruptibly(look_along, state, qpos[index], search.target, camera, config, size)
            frames = jax.tree.map(np.asarray, seen)
            for place in range(min(_CHUNK, len(qpos) - first)):
                yield jax.tree.map(lambda x, i=place: x[i], frames)

    pictures = looks()
    return np.asarray(next(pictures).wrist), pictures
