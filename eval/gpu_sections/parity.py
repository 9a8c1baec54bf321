"""Compares what the accelerator computes with what a CPU computes.

`compute` runs on the accelerator, and in a process of its own on the CPU:
`JAX_PLATFORMS=cpu python eval/gpu_sections/parity.py reference.npz [--quick]`. On the accelerator, images and IK are
computed with JAX's default precision of matrix products and with the highest. A GPU's default may round factors to 10
bits (TF32).
"""

from __future__ import annotations

import contextlib
import dataclasses
import os
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

import vsearch_jax as vs
from benchmarks.render_peers import FOVY, mesh_case, project_case
from gpu_sections.learning import quick_config
from gpu_sections.measure import Row, Settings
from gpu_sections.planning import random_configurations
from vsearch_jax import render
from vsearch_jax.config import IKConfig, SceneConfig
from vsearch_jax.planning import ik
from vsearch_jax.robot import build_arm, camera_pose, forward_kinematics
from vsearch_jax.scene import Scene, build_scene
from vsearch_jax.types import Camera

SIZE, NUM_IMAGES, NUM_POSES = 64, 4, 64
MIN_EQUAL_IDS = 0.999
"""Where two surfaces meet within a pixel, rounding decides which of them is seen."""
MAX_DEPTH_ERROR = 1e-3
"""In m, where the geom ids agree."""
MAX_RGB_ERROR = 1.0 / 255.0
"""Mean absolute difference."""
MAX_SOLVED_DIFFERENCE = 0.02
MAX_POSITION_ERROR = 1.1e-3
"""In m, of solved poses, by C MuJoCo's kinematics; IK's own tolerance is 1e-3."""
MAX_LOSS_DIFFERENCE = 0.05
"""Relative, of the encoder's loss over all updates of the small run."""
MAX_REWARD_DIFFERENCE = 0.1
"""Mean absolute difference over the policy iterations of the small run."""


def compute(config: vs.Config, precisions: Sequence[str] = ("default",)) -> dict[str, np.ndarray]:
    """Returns images, IK solutions and metrics of a whole run of `config`, by name."""
    arrays: dict[str, np.ndarray] = {}
    for precision in precisions:
        with contextlib.nullcontext() if precision == "default" else jax.default_matmul_precision(precision):
            for scene in ("project", "mesh"):
                for plane, values in zip(("rgb", "depth", "geom_id"), _images(scene), strict=True):
                    arrays[f"{scene}/{precision}/{plane}"] = values
            arrays[f"ik/{precision}/is_solved"], arrays[f"ik/{precision}/position_error"] = _ik()
    return arrays | {f"train/{name}": values for name, values in _train(config).items()}


def _images(name: str) -> tuple[np.ndarray, ...]:
    case = project_case(NUM_IMAGES) if name == "project" else mesh_case(5000, NUM_IMAGES, has_lamp=True)
    scene, data = render.compile_scene(case.model), render.poses(case.data)

    def draw(position: jax.Array, rotation: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        image = render.render(scene, data, Camera(position, rotation, jnp.float32(FOVY)), (SIZE, SIZE))
        return image.rgb, image.depth, image.geom_id

    cameras = jnp.asarray(case.positions, jnp.float32), jnp.asarray(case.rotations, jnp.float32)
    return tuple(np.asarray(plane) for plane in jax.jit(jax.vmap(draw))(*cameras))


def _ik() -> tuple[np.ndarray, np.ndarray]:
    """Returns bool[N], whether each pose is solved, and f64[N] the solution's position error in m by C MuJoCo."""
    scene = build_scene(SceneConfig())
    arm, config = build_arm(scene), IKConfig()
    wanted, present = random_configurations(arm, 1, NUM_POSES), random_configurations(arm, 2, NUM_POSES)
    solve = jax.vmap(lambda q, start: ik(arm, camera_pose(arm, forward_kinematics(arm, q)), start, config))
    result = jax.jit(solve)(wanted, present)
    error = _camera_positions(scene, np.asarray(result.qpos)) - _camera_positions(scene, wanted)
    return np.asarray(result.is_converged), np.linalg.norm(error, axis=1)


def _camera_positions(scene: Scene, qpos: np.ndarray) -> np.ndarray:
    """Returns the wrist camera's positions f64[N, 3] m in world by C MuJoCo, for joint values f32[N, nq]."""
    data, positions = mujoco.MjData(scene.mj_model), []
    for values in qpos:
        data.qpos[:] = values
        mujoco.mj_kinematics(scene.mj_model, data)
        mujoco.mj_camlight(scene.mj_model, data)
        positions.append(data.cam_xpos[scene.camera_id].copy())
    return np.stack(positions)


def _train(config: vs.Config) -> dict[str, np.ndarray]:
    """Returns metrics f32[iterations] of a whole run."""
    state, chunks = vs.init(jax.random.key(3), config), []
    for _ in range(config.num_chunks):
        state, metrics = vs.train(state, config)
        chunks.append(metrics)
    names = ("encoder_loss", "reward", "critic_loss")
    return {name: np.concatenate([np.asarray(metrics[name]) for metrics in chunks]) for name in names}


def choose_config(is_quick: bool) -> vs.Config:
    """Returns the config of the small run; in a quick run that of the other sections, which is then compiled once."""
    return quick_config() if is_quick else dataclasses.replace(vs.Config.preset("smoke"), num_chunks=1)


def start_reference(folder: Path, is_quick: bool) -> tuple[subprocess.Popen[bytes], Path]:
    """Starts the process that computes the CPU's arrays; returns it and the file that it writes."""
    path = folder / "reference.npz"
    environment = {**os.environ, "JAX_PLATFORMS": "cpu", "CUDA_VISIBLE_DEVICES": ""}
    command = [sys.executable, str(Path(__file__).resolve()), str(path), *(["--quick"] if is_quick else [])]
    with (folder / "reference.log").open("wb") as log:
        return subprocess.Popen(command, env=environment, stdout=log, stderr=log), path


def run(settings: Settings, reference: tuple[subprocess.Popen[bytes], Path]) -> Iterator[Row]:
    """Yields a row for each comparison with the CPU: the difference, the largest allowed, and whether it holds."""
    precisions = ("default",) if settings.is_quick else ("default", "highest")
    ours = compute(choose_config(settings.is_quick), precisions)
    process, path = reference
    if process.wait(timeout=max(settings.seconds_left, 120.0)) != 0:
        raise RuntimeError("the reference on the CPU failed; see reference.log")
    with np.load(path) as file:
        theirs = dict(file)
    for precision in precisions:
        for scene in ("project", "mesh"):
            yield from _compare_images(f"{scene}/{precision}", f"{scene}/default", ours, theirs)
        is_solved = ours[f"ik/{precision}/is_solved"]
        off = abs(float(is_solved.mean()) - float(theirs["ik/default/is_solved"].mean()))
        yield _verdict(f"ik/{precision}: share of solved poses", off, MAX_SOLVED_DIFFERENCE)
        worst = float(ours[f"ik/{precision}/position_error"][is_solved].max(initial=0.0))
        yield _verdict(f"ik/{precision}: position error of solved poses, largest (m)", worst, MAX_POSITION_ERROR)
    loss, expected = ours["train/encoder_loss"], theirs["train/encoder_loss"]
    off = float(np.nanmax(np.abs(loss - expected) / np.abs(expected)))
    yield _verdict("train: encoder loss, largest relative difference", off, MAX_LOSS_DIFFERENCE)
    off = float(np.nanmean(np.abs(ours["train/reward"] - theirs["train/reward"])))
    yield _verdict("train: reward, mean difference", off, MAX_REWARD_DIFFERENCE)
    is_finite = np.isfinite(ours["train/critic_loss"]) == np.isfinite(theirs["train/critic_loss"])
    yield _verdict(
        "train: iterations whose critic loss is finite on one of the two only", float((~is_finite).sum()), 0.0
    )


def _compare_images(
    name: str, reference: str, ours: dict[str, np.ndarray], theirs: dict[str, np.ndarray]
) -> Iterator[Row]:
    is_equal = ours[f"{name}/geom_id"] == theirs[f"{reference}/geom_id"]
    yield _verdict(f"{name}: share of unequal geom ids", 1.0 - float(is_equal.mean()), 1.0 - MIN_EQUAL_IDS)
    depth, expected = ours[f"{name}/depth"], theirs[f"{reference}/depth"]
    is_hit = is_equal & np.isfinite(depth) & np.isfinite(expected)
    off = float(np.abs(depth[is_hit] - expected[is_hit]).max(initial=0.0))
    yield _verdict(f"{name}: depth, largest difference (m)", off, MAX_DEPTH_ERROR)
    off = float(np.abs(ours[f"{name}/rgb"] - theirs[f"{reference}/rgb"]).mean())
    yield _verdict(f"{name}: rgb, mean difference", off, MAX_RGB_ERROR)


def _verdict(name: str, value: float, allowed: float) -> Row:
    return {"what": name, "difference": value, "allowed": allowed, "holds": bool(value <= allowed)}


if __name__ == "__main__":
    arrays = compute(choose_config("--quick" in sys.argv[2:]))
    np.savez(sys.argv[1], **arrays)  # pyright: ignore[reportArgumentType] # numpy's stub takes them for a flag
