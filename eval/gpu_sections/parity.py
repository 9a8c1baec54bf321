"""Is what the accelerator computes what a CPU computes?

`compute` runs once on the accelerator and once in a process of its own on the CPU:
`JAX_PLATFORMS=cpu python eval/gpu_sections/parity.py reference.npz`. Images and IK are computed with JAX's default
precision of matrix products and with the highest, since a GPU's default may round to 10 bits (TF32).
"""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import jax
import jax.numpy as jnp
import numpy as np

import vsearch_jax as vs
from benchmarks.render_peers import FOVY, mesh_case, project_case
from gpu_sections.measure import Row, Settings
from gpu_sections.planning import random_configurations
from vsearch_jax import render
from vsearch_jax.config import IKConfig, SceneConfig
from vsearch_jax.planning import ik
from vsearch_jax.robot.arm import build_arm, camera_pose, forward_kinematics
from vsearch_jax.scene import build_scene
from vsearch_jax.types import Camera

SIZE, NUM_IMAGES, NUM_POSES = 64, 4, 64
# Where two surfaces meet within a pixel, rounding decides which one is seen.
MIN_EQUAL_IDS = 0.999
MAX_DEPTH_ERROR = 1e-3
"""In m, where the geom ids agree."""
MAX_RGB_ERROR = 1.0 / 255.0
"""Mean absolute difference."""
MAX_CONVERGED_DIFFERENCE = 0.02
MAX_LOSS_DIFFERENCE = 0.02
"""Relative, of the encoder's loss over one chunk of the preset `smoke`."""
PRECISIONS = ("default", "highest")


def compute() -> dict[str, np.ndarray]:
    """Returns images, joints and losses by name."""
    arrays: dict[str, np.ndarray] = {}
    for precision in PRECISIONS:
        with contextlib.nullcontext() if precision == "default" else jax.default_matmul_precision("highest"):
            for scene in ("project", "mesh"):
                rgb, depth, geom_id = _images(scene)
                arrays |= {f"{scene}/{precision}/rgb": rgb, f"{scene}/{precision}/depth": depth}
                arrays[f"{scene}/{precision}/geom_id"] = geom_id
            arrays[f"ik/{precision}/is_converged"], arrays[f"ik/{precision}/error"] = _ik()
    arrays["train/loss"] = _losses()
    return arrays


def _images(name: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    case = project_case(NUM_IMAGES) if name == "project" else mesh_case(5000, NUM_IMAGES, has_lamp=True)
    scene, data = render.compile_scene(case.model), render.poses(case.data)

    def draw(position: jax.Array, rotation: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        image = render.render(scene, data, Camera(position, rotation, jnp.float32(FOVY)), (SIZE, SIZE))
        return image.rgb, image.depth, image.geom_id

    images = jax.jit(jax.vmap(draw))(jnp.asarray(case.positions, jnp.float32), jnp.asarray(case.rotations, jnp.float32))
    rgb, depth, geom_id = (np.asarray(plane) for plane in images)
    return rgb, depth, geom_id


def _ik() -> tuple[np.ndarray, np.ndarray]:
    """Returns bool[N] whether each pose is solved, and f32[N] the position error in m that C-accurate FK sees."""
    arm, config = build_arm(build_scene(SceneConfig())), IKConfig()
    wanted, present = random_configurations(arm, 1, NUM_POSES), random_configurations(arm, 2, NUM_POSES)
    solve = jax.jit(jax.vmap(lambda q, start: ik(arm, camera_pose(arm, forward_kinematics(arm, q)), start, config)))
    result = solve(wanted, present)
    return np.asarray(result.is_converged), np.asarray(result.position_error)


def _losses() -> np.ndarray:
    """Returns f32[n]: the encoder's loss over the first chunk of the preset `smoke`."""
    config = vs.Config.preset("smoke")
    state = vs.init(jax.random.key(3), config)
    _, metrics = vs.train(state, config)
    return np.asarray(metrics["encoder_loss"])


def start_reference(folder: Path) -> tuple[subprocess.Popen[bytes], Path]:
    """Starts the process that computes the CPU's arrays; returns it and the file that it writes."""
    path = folder / "reference.npz"
    environment = {**os.environ, "JAX_PLATFORMS": "cpu", "CUDA_VISIBLE_DEVICES": ""}
    command = [sys.executable, str(Path(__file__).resolve()), str(path)]
    with (folder / "reference.log").open("wb") as log:
        return subprocess.Popen(command, env=environment, stdout=log, stderr=log), path


def run(settings: Settings, reference: tuple[subprocess.Popen[bytes], Path]) -> Iterator[Row]:
    """Yields a row for each comparison with the CPU, with its tolerance and whether it holds."""
    ours = compute()
    process, path = reference
    if process.wait(timeout=max(settings.seconds_left, 1.0)) != 0:
        raise RuntimeError(f"the reference on the CPU failed; see {path.with_suffix('.log').name}")
    with np.load(path) as file:
        theirs = dict(file)
    for precision in PRECISIONS:
        for scene in ("project", "mesh"):
            yield from _compare_images(f"{scene}/{precision}", ours, theirs)
        name = f"ik/{precision}/is_converged"
        off = abs(float(ours[name].mean()) - float(theirs[name].mean()))
        yield _verdict(f"IK solved, difference ({precision})", off, MAX_CONVERGED_DIFFERENCE)
    loss, expected = ours["train/loss"], theirs["train/loss"]
    off = np.abs(loss - expected) / np.abs(expected)
    yield _verdict("encoder loss of one chunk, largest relative difference", float(np.nanmax(off)), MAX_LOSS_DIFFERENCE)


def _compare_images(name: str, ours: dict[str, np.ndarray], theirs: dict[str, np.ndarray]) -> Iterator[Row]:
    is_equal = ours[f"{name}/geom_id"] == theirs[f"{name}/geom_id"]
    yield _verdict(f"{name}: share of unequal geom ids", 1.0 - float(is_equal.mean()), 1.0 - MIN_EQUAL_IDS)
    is_hit = is_equal & np.isfinite(ours[f"{name}/depth"]) & np.isfinite(theirs[f"{name}/depth"])
    off = np.abs(ours[f"{name}/depth"] - theirs[f"{name}/depth"])[is_hit]
    yield _verdict(f"{name}: depth, largest difference (m)", float(off.max(initial=0.0)), MAX_DEPTH_ERROR)
    off = np.abs(ours[f"{name}/rgb"] - theirs[f"{name}/rgb"])
    yield _verdict(f"{name}: rgb, mean difference", float(off.mean()), MAX_RGB_ERROR)


def _verdict(name: str, value: float, allowed: float) -> Row:
    return {"what": name, "difference": value, "allowed": allowed, "holds": bool(value <= allowed)}


if __name__ == "__main__":
    np.savez(sys.argv[1], **compute())  # pyright: ignore[reportArgumentType] # its stub takes the arrays for a flag
