"""Tests of the film of a search: it shows the arm's motions in real time."""

import dataclasses
import re
import subprocess
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from imageio_ffmpeg import get_ffmpeg_exe

import vsearch_jax as vs
from samples import made_up
from vsearch_jax import encoder as encoders
from vsearch_jax.config import ConfigError
from vsearch_jax.evaluation import record_search
from vsearch_jax.film import make_film
from vsearch_jax.film.motions import FPS, FilmedSearch, record_motions
from vsearch_jax.film.video import END_SECONDS, HOLD_SECONDS
from vsearch_jax.search import sac
from vsearch_jax.types import TrainState

NUM_STEPS = 2
HEIGHT = 90


@pytest.fixture(scope="module")
def config() -> vs.Config:
    smoke = vs.Config.preset("smoke")
    # Silhouettes need no light, which takes half of the renderer's compile time.
    encoder = dataclasses.replace(smoke.encoder, input="silhouette")
    env = dataclasses.replace(smoke.env, episode_length=NUM_STEPS, action_scale_deg=5.0)
    return dataclasses.replace(smoke, encoder=encoder, env=env)


@pytest.fixture(scope="module")
def state(config: vs.Config) -> TrainState:
    """Returns a state with the parts that a film reads. The networks are random, since `init` takes long to compile."""
    random = np.random.default_rng(0)

    def random_like(function):
        shapes = jax.eval_shape(function, jax.random.key(0))
        return jax.tree.map(lambda x: jnp.asarray(0.2 * random.normal(size=x.shape), x.dtype), shapes)

    sac_state = random_like(
        lambda key: sac.init(key, config.sac, 2 * config.encoder.code_size + 9, code_size=config.encoder.code_size)
    )
    actors = jax.tree.map(lambda x: x[None], sac_state)
    encoder = random_like(lambda key: encoders.init(key, config))
    unused: Any = None
    return TrainState(
        encoder=encoder,
        reach=made_up.reach(),
        sac=actors,
        key=jax.random.key(2),
        step=jnp.int32(0),
        pool=unused,
        env=unused,
        replay=unused,
    )


def with_motion(config: vs.Config, motion: str) -> vs.Config:
    return dataclasses.replace(config, env=dataclasses.replace(config.env, reachable="path", motion=motion))


def record(state: TrainState, episode: int | None, config: vs.Config) -> FilmedSearch:
    """Returns the search as numpy arrays."""
    key = None if episode is None else jax.random.key(episode)
    return jax.tree.map(np.asarray, record_motions(state, key, config))


def read_film(path: Path) -> tuple[str, np.ndarray]:
    """Returns ffmpeg's description of a film, and its frames u8[N, H, W, 3]."""
    options = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-fps_mode", "passthrough", "-"]
    done = subprocess.run([get_ffmpeg_exe(), "-i", str(path), *options], capture_output=True, check=True)
    description = done.stderr.decode()
    found = re.search(r"Video: .* (\d+)x(\d+)", description)
    assert found, description
    width, height = (int(number) for number in found.groups())
    return description, np.frombuffer(done.stdout, np.uint8).reshape(-1, height, width, 3)


def check_motions(search: FilmedSearch) -> None:
    """Checks that each motion starts at the end of the last one and respects the speed limits."""
    here = search.start_qpos
    for qpos, seconds, is_reachable in zip(search.qpos, search.durations, search.is_reachable, strict=True):
        assert (seconds > 0.0) == is_reachable
        np.testing.assert_allclose(qpos[0], here, atol=0.02)
        # No joint of the LWR turns faster than 180 degrees per second.
        assert np.abs(np.diff(qpos, axis=0)).max() < np.pi / FPS + 0.02
        here = qpos[-1]
        rest = qpos[int(np.ceil(seconds * FPS)) :]
        np.testing.assert_allclose(rest, np.broadcast_to(here, rest.shape), atol=1e-6)


@pytest.fixture(scope="module")
def film(config: vs.Config, state: TrainState, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """Returns the path of a film, and the line that `make_film` returned."""
    out = tmp_path_factory.mktemp("film") / "search.mp4"
    message = make_film(out, state, config, "kinematic", None, height=HEIGHT)
    return out, message


@pytest.mark.slow
def test_a_film_shows_the_search_in_real_time(config: vs.Config, state: TrainState, film: tuple[Path, str]) -> None:
    out, message = film
    search = record(state, None, with_motion(config, "kinematic"))
    check_motions(search)
    assert search.is_reachable.all() and search.num_steps == NUM_STEPS
    description, frames = read_film(out)
    assert re.search(rf"Video: h264 .*yuv420p.* {FPS} fps", description), description
    frames = frames.astype(float)
    assert list(out.parent.iterdir()) == [out]
    assert frames.shape[1:] == (HEIGHT, HEIGHT * 16 // 9, 3)
    counts = np.maximum(np.ceil(search.durations * FPS), 1).astype(int)
    hold, end = round(HOLD_SECONDS * FPS), round(END_SECONDS * FPS)
    assert len(frames) == 1 + counts.sum() + NUM_STEPS * hold + end
    assert f"{len(frames) / FPS:.1f} s" in message and "not found after 2 steps" in message
    # Left: the arm moves between holds. Right: the curve grows.
    change = np.abs(np.diff(frames, axis=0))
    left, right = change[:, :, : frames.shape[2] // 2].mean((1, 2, 3)), change[:, :, frames.shape[2] // 2 :]
    first_motion = slice(hold + 1, hold + counts[0] - 1)
    assert left[first_motion].mean() > 10 * left[: hold - 1].mean() + 0.05
    assert right[first_motion].mean() > 0.05
    assert left[-end + 2 :].max() < 0.5


@pytest.mark.slow
def test_two_episodes_are_two_searches(config: vs.Config, state: TrainState) -> None:
    searches = [record(state, episode, with_motion(config, "kinematic")) for episode in (0, 1)]
    ends = [jax.tree.leaves((search.start_qpos, search.target.view)) for search in searches]
    for first, second in zip(*ends, strict=True):
        assert np.abs(first - second).max() > 0.01


def test_error_names_an_episode_out_of_range(config: vs.Config, state: TrainState, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="`episode` is -1; allowed: 0 to 4294967295"):
        make_film(tmp_path / "film.mp4", state, config, "kinematic", -1)
    assert not any(tmp_path.iterdir())


@pytest.mark.slow
@pytest.mark.parametrize("motion", ["kinematic", "dynamic"])
def test_the_film_shows_the_search_of_the_task(config: vs.Config, state: TrainState, motion: str) -> None:
    config = with_motion(config, motion)
    search, recorded = record(state, None, config), jax.tree.map(np.asarray, record_search(state, config))
    check_motions(search)
    np.testing.assert_allclose(search.similarity, recorded["similarity"], atol=1e-4)
    assert search.num_steps == recorded["num_steps"] == NUM_STEPS


@pytest.mark.slow
def test_a_dynamic_film_shows_the_dynamics(config: vs.Config, state: TrainState) -> None:
    kinematic, dynamic = (record(state, None, with_motion(config, motion)) for motion in ("kinematic", "dynamic"))
    difference = np.abs(dynamic.qpos[0] - kinematic.qpos[0]).max()
    assert 1e-4 < difference < 0.05
    settling_time = config.planning.settling_time
    assert dynamic.durations[0] == pytest.approx(kinematic.durations[0] + settling_time, abs=1e-4)
