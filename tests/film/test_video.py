"""The film of a search: it shows what the arm does, all of the arm, and is whole or not there."""

import dataclasses
import re
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from imageio_ffmpeg import get_ffmpeg_exe

import vsearch_jax as vs
from samples import made_up
from vsearch_jax import encoder as encoders
from vsearch_jax import report
from vsearch_jax.config import ConfigError, SceneConfig
from vsearch_jax.evaluation import FPS, film_search, overview_camera, record_search
from vsearch_jax.film.video import END_SECONDS, HOLD_SECONDS, make_video
from vsearch_jax.scene import build_scene
from vsearch_jax.search import sac
from vsearch_jax.types import TrainState

NUM_STEPS = 2
HEIGHT = 90


@pytest.fixture(scope="module")
def config() -> vs.Config:
    smoke = vs.Config.preset("smoke")
    # Silhouettes need no light, which is half of what a picture takes to compile.
    encoder = dataclasses.replace(smoke.encoder, input="silhouette")
    env = dataclasses.replace(smoke.env, episode_length=NUM_STEPS, action_scale_deg=5.0)
    return dataclasses.replace(smoke, encoder=encoder, env=env)


@pytest.fixture(scope="module")
def state(config: vs.Config) -> TrainState:
    """What a film reads of a state, its networks made up: to initialise them takes longer to compile."""
    random = np.random.default_rng(0)

    def made(function):
        shapes = jax.eval_shape(function, jax.random.key(0))
        return jax.tree.map(lambda x: jnp.asarray(0.2 * random.normal(size=x.shape), x.dtype), shapes)

    sac_state = made(lambda key: sac.init(key, config.sac, 2 * config.encoder.code_size + 9))
    actors = jax.tree.map(lambda x: x[None], sac_state)
    encoder = made(lambda key: encoders.init(key, config))
    return TrainState(encoder, made_up.reach(), None, actors, None, None, jax.random.key(2), jnp.int32(0))


def _moving(config: vs.Config, motion: str) -> vs.Config:
    return dataclasses.replace(config, env=dataclasses.replace(config.env, reachable="path", motion=motion))


def _read(path: Path) -> tuple[str, np.ndarray]:
    """What ffmpeg says of a film, and its frames."""
    options = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-fps_mode", "passthrough", "-"]
    done = subprocess.run([get_ffmpeg_exe(), "-i", str(path), *options], capture_output=True, check=True)
    about = done.stderr.decode()
    found = re.search(r"Video: .* (\d+)x(\d+)", about)
    assert found, about
    width, height = (int(number) for number in found.groups())
    return about, np.frombuffer(done.stdout, np.uint8).reshape(-1, height, width, 3)


def _check_motions(search) -> None:
    """Each motion leads on from where the last one ended, no faster than the joints can."""
    here = search.start
    for joints, seconds, is_reachable in zip(search.joints, search.seconds, search.is_reachable, strict=True):
        assert (seconds > 0.0) == is_reachable
        np.testing.assert_allclose(joints[0], here, atol=0.02)
        # No joint of the LWR turns faster than 180 degrees a second.
        assert np.abs(np.diff(joints, axis=0)).max() < np.pi / FPS + 0.02
        here = joints[-1]
        rest = joints[int(np.ceil(seconds * FPS)) :]
        np.testing.assert_allclose(rest, np.broadcast_to(here, rest.shape), atol=1e-6)


@pytest.fixture(scope="module")
def film(config: vs.Config, state: TrainState, tmp_path_factory: pytest.TempPathFactory):
    out = tmp_path_factory.mktemp("film") / "search.mp4"
    told = make_video(out, state, config, "kinematic", None, height=HEIGHT)
    return out, told


def test_a_film_shows_the_search_in_real_time(config: vs.Config, state: TrainState, film) -> None:
    out, told = film
    search = jax.tree.map(np.asarray, film_search(state, None, _moving(config, "kinematic")))
    _check_motions(search)
    assert search.is_reachable.all() and search.num_steps == NUM_STEPS
    about, frames = _read(out)
    assert re.search(rf"Video: h264 .*yuv420p.* {FPS} fps", about), about
    frames = frames.astype(float)
    assert list(out.parent.iterdir()) == [out]
    assert frames.shape[1:] == (HEIGHT, HEIGHT * 16 // 9, 3)
    counts = np.maximum(np.ceil(search.seconds * FPS), 1).astype(int)
    hold, end = round(HOLD_SECONDS * FPS), round(END_SECONDS * FPS)
    assert len(frames) == 1 + counts.sum() + NUM_STEPS * hold + end
    assert f"{len(frames) / FPS:.1f} s" in told and "not found after 2 steps" in told
    # The arm moves between holds, left; the curve grows, right.
    change = np.abs(np.diff(frames, axis=0))
    left, right = change[:, :, : frames.shape[2] // 2].mean((1, 2, 3)), change[:, :, frames.shape[2] // 2 :]
    moving = slice(hold + 1, hold + counts[0] - 1)
    assert left[moving].mean() > 10 * left[: hold - 1].mean() + 0.05
    assert right[moving].mean() > 0.05
    assert left[-end + 2 :].max() < 0.5


@pytest.mark.slow
def test_a_seed_films_another_search(config: vs.Config, state: TrainState) -> None:
    films = [film_search(state, jax.random.key(seed), _moving(config, "kinematic")) for seed in (0, 1)]
    for searches in zip(*(jax.tree.leaves((film.start, film.target.view)) for film in films), strict=True):
        assert np.abs(np.subtract(*searches)).max() > 0.01


def test_a_seed_out_of_range_is_named(config: vs.Config, state: TrainState, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="seed is -1; allowed: 0 to 4294967295"):
        make_video(tmp_path / "film.mp4", state, config, "kinematic", -1)


@pytest.mark.slow
@pytest.mark.parametrize("motion", ["kinematic", "dynamic"])
def test_the_film_is_of_the_search_that_the_task_makes(config: vs.Config, state: TrainState, motion: str) -> None:
    config = _moving(config, motion)
    search, recorded = (
        jax.tree.map(np.asarray, f) for f in (film_search(state, None, config), record_search(state, config))
    )
    _check_motions(search)
    np.testing.assert_allclose(search.similarity, recorded["similarity"], atol=1e-4)
    assert search.num_steps == recorded["num_steps"] == NUM_STEPS


@pytest.mark.slow
def test_a_dynamic_film_shows_where_the_dynamics_take_the_arm(config: vs.Config, state: TrainState) -> None:
    planned, driven = (
        jax.tree.map(np.asarray, film_search(state, None, _moving(config, motion)))
        for motion in ("kinematic", "dynamic")
    )
    away = np.abs(driven.joints[0] - planned.joints[0]).max()
    assert 1e-4 < away < 0.05
    settling = config.planning.settling_time
    assert driven.seconds[0] == pytest.approx(planned.seconds[0] + settling, abs=1e-4)


@pytest.mark.parametrize(("arm", "height"), [("lwr", 1.355), ("ur5e", 1.0), ("lwr", 3.0)])
@pytest.mark.parametrize("size", [(72, 64), (64, 200)])
def test_the_overview_holds_arm_mount_and_object_and_no_more(arm: str, height: float, size: tuple[int, int]) -> None:
    scene = build_scene(SceneConfig(arm=arm, mount_height=height))
    model, random = scene.mj_model, np.random.default_rng(0)
    qpos = random.uniform(*model.jnt_range.T, (40, model.nq))
    camera = overview_camera(scene, qpos, size)
    data = mujoco.MjData(model)
    slopes = []
    for joints in qpos:
        data.qpos[:] = joints
        mujoco.mj_kinematics(model, data)
        geoms = [*scene.arm_geom_ids, *scene.mount_geom_ids, *scene.object_geom_ids]
        x, y, z = ((data.geom_xpos[geoms] - np.asarray(camera.position)) @ np.asarray(camera.rotation)).T
        assert z.max() < 0.0
        # A sphere around the geom is in view where its middle is, by its radius.
        slopes.append((np.abs(x / z).max(), np.abs(y / z).max()))
    half = np.tan(float(camera.fovy) / 2)
    largest = np.max(slopes, axis=0) / (half * size[1] / size[0], half)
    assert largest.max() < 1.0
    assert largest.max() > 0.7


def test_what_cannot_be_finished_leaves_nothing(tmp_path: Path) -> None:
    def frames():
        yield from np.zeros((50, 32, 32, 3), np.uint8)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        report.write_film(tmp_path / "film.mp4", frames(), FPS, (32, 32))
    assert not any(tmp_path.iterdir())


def test_a_full_disk_is_told_and_leaves_nothing(tmp_path: Path) -> None:
    code = f"""
import resource, numpy as np
from vsearch_jax import report
noise = np.random.default_rng(0).integers(0, 256, (40, 64, 64, 3), dtype=np.uint8)
resource.setrlimit(resource.RLIMIT_FSIZE, (60_000, 60_000))
try:
    report.write_film(__import__("pathlib").Path({str(tmp_path / "film.mp4")!r}), noise, 25, (64, 64))
except report.FilmError as error:
    print(error)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "film.mp4: the encoder stopped (" in done.stdout and "make room" in done.stdout, done
    assert not done.stderr
    assert not any(tmp_path.iterdir())
