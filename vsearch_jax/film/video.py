"""Makes a film of one search by the policy of a finished run."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from pathlib import Path
from typing import Literal, NamedTuple

import jax
import numpy as np

from vsearch_jax.config import Config, ConfigError
from vsearch_jax.film.motions import FPS, MAX_SECONDS, FilmedSearch, Frames, record_motions, render_frames
from vsearch_jax.film.overview import overview_camera
from vsearch_jax.film.page import FilmPage, Moment
from vsearch_jax.film.writer import FilmError, find_ffmpeg, write_film
from vsearch_jax.runs.folder import MAX_SEED
from vsearch_jax.runs.interrupts import call_interruptibly
from vsearch_jax.scene import build_scene
from vsearch_jax.types import TrainState

HEIGHT = 720
"""Default height of a film in pixels. Its width is 16/9 of the height."""
HOLD_SECONDS, END_SECONDS = 0.6, 2.5
"""How long a film shows each view whose image is taken, and the last view, in s."""
_AXIS_MARGIN = 0.25
"""The curve's axis starts this much below the lowest cosine of the images taken: in motion the cosine may be lower."""
_CHUNK_SIZE = 32
"""Frames held in memory at a time."""


class _Plan(NamedTuple):
    """The frames of a film without holds; N is their number.

    Attributes:
      qpos: f32[N, nq] rad or m.
      steps: i32[N], step of the search that a frame belongs to; 0 is the start.
      is_taken: bool[N], whether the policy uses the wrist image of a frame.
    """

    qpos: np.ndarray
    steps: np.ndarray
    is_taken: np.ndarray


def make_film(
    out: Path,
    state: TrainState,
    config: Config,
    motion: Literal["dynamic", "kinematic"],
    episode: int | None,
    height: int = HEIGHT,
) -> str:
    """Films one search by the first policy of a run, and writes the film as an .mp4 file.

    The arm moves in real time. The film holds each view whose image the policy uses.

    Args:
      out: the new file; its name ends in .mp4.
      state: state of a finished run.
      config: the run's config.
      motion: "dynamic" shows the arm as its dynamics move it, "kinematic" exactly on the planned paths.
      episode: number of a random episode, 0 to `MAX_SEED`, which gives initial view and target; None for the search of
        the run's report.
      height: height of the film in pixels; a multiple of 18, so that the width is whole and even.

    Returns:
      A line for the user: file, length and result of the search.

    Raises:
      ConfigError: the episode is out of range.
      PlanningError: a joint of the arm has no speed limit.
      SceneError: motion is dynamic, and a joint of the arm has no position actuator.
      FilmError: ffmpeg is not installed, a motion is too long for a film, or the encoder stopped, for example on a
        full disk.
    """
    if episode is not None and not 0 <= episode <= MAX_SEED:
        raise ConfigError(f"`episode` is {episode}; allowed: 0 to {MAX_SEED}")
    find_ffmpeg()  # before the search, so that a missing ffmpeg is reported at once
    config = dataclasses.replace(config, env=dataclasses.replace(config.env, reachable="path", motion=motion))
    key = None if episode is None else jax.random.key(episode)
    search: FilmedSearch = jax.tree.map(np.asarray, call_interruptibly(record_motions, state, key, config))
    longest = float(search.durations.max())
    if longest > MAX_SECONDS:
        raise FilmError(
            f"a motion takes {longest:.0f} s, but a film shows at most {MAX_SECONDS} s of each motion; film another "
            "search with `episode`, or raise the speed limits (`user` of the joints) in the arm's file"
        )
    plan = _plan_frames(search)
    frames = _draw_frames(state, search, plan, config, height)
    num_frames = write_film(out, frames, FPS, (height, height * 16 // 9))
    result = "found" if search.is_found else "not found"
    return f"wrote {out}: {num_frames / FPS:.1f} s, the target is {result} after {int(search.num_steps)} steps"


def _plan_frames(search: FilmedSearch) -> _Plan:
    """Cuts each motion to its duration and joins them."""
    counts = np.maximum(np.ceil(search.durations * FPS), 1).astype(int)[: int(search.num_steps)]
    motions = [qpos[:count] for qpos, count in zip(search.qpos, counts, strict=False)]
    is_taken = np.zeros(1 + counts.sum(), bool)
    is_taken[np.cumsum([0, *counts])] = True
    steps = np.repeat(np.arange(1 + len(counts)), [1, *counts])
    return _Plan(np.concatenate([search.start_qpos[None], *motions]), steps, is_taken)


def _draw_frames(
    state: TrainState, search: FilmedSearch, plan: _Plan, config: Config, height: int
) -> Iterator[np.ndarray]:
    """Yields the film's frames, u8[H, W, 3], holds included."""
    last = len(plan.qpos) - 1
    target_image, rendered = _render(state, search, plan, config, height)
    lowest = max(float(search.similarity.min()) - _AXIS_MARGIN, -1.05)
    page = FilmPage(target_image, (max(last, 1) / FPS, lowest), config.env.threshold, height)
    for number, images in enumerate(rendered):
        is_taken = bool(plan.is_taken[number])
        moment = Moment(
            overview=np.asarray(images.overview),
            wrist=np.asarray(images.wrist),
            time=number / FPS,
            similarity=float(images.similarity),
            view_deg=(float(np.rad2deg(images.view.azimuth)) % 360.0, float(np.rad2deg(images.view.elevation))),
            caption=_caption(search, int(plan.steps[number]), is_taken),
            is_taken=is_taken,
        )
        hold = (END_SECONDS if number == last else HOLD_SECONDS) if is_taken else 0.0
        frame = page.draw(moment)
        for _ in range(1 + round(hold * FPS)):
            yield frame


def _caption(search: FilmedSearch, step: int, is_taken: bool) -> str:
    if step == 0:
        return "start"
    name = f"step {step}"
    if not search.is_reachable[step - 1]:
        return f"{name}: out of reach, the arm does not move"
    if not is_taken:
        return name
    if step < search.num_steps:
        return f"{name}: image taken"
    return f"{name}: found" if search.is_found else f"{name}: not found, no steps are left"


def _render(
    state: TrainState, search: FilmedSearch, plan: _Plan, config: Config, height: int
) -> tuple[np.ndarray, Iterator[Frames]]:
    """Returns the target image u8[h, h, 3] and an iterator over the rendered frames, one by one."""
    size = (height, height * 8 // 9)
    # The target is rendered as one more frame, since a call for it alone would be compiled anew.
    qpos = np.concatenate([search.target.qpos[None], plan.qpos])
    camera = overview_camera(build_scene(config.scene), plan.qpos, size)

    def render_in_chunks() -> Iterator[Frames]:
        for first in range(0, len(qpos), _CHUNK_SIZE):
            # The last chunk repeats the last frame to keep its shape.
            index = np.minimum(np.arange(first, first + _CHUNK_SIZE), len(qpos) - 1)
            chunk = call_interruptibly(render_frames, state, qpos[index], search.target, camera, config, size)
            chunk = jax.tree.map(np.asarray, chunk)
            for i in range(min(_CHUNK_SIZE, len(qpos) - first)):
                yield jax.tree.map(lambda x, i=i: x[i], chunk)

    rendered = render_in_chunks()
    return np.asarray(next(rendered).wrist), rendered
