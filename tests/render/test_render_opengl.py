"""Colours of the example scene against `mujoco.Renderer`."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import jax
import mujoco
import numpy as np
import pytest

from oracles.render import cast_image, forward, on_outline
from vsearch_jax import render

EXAMPLE = Path(__file__).resolve().parents[2] / "examples" / "workshop.xml"
SIZE = (480, 640)
# Draws camera "room" of a model (argument 1) without the effects that we do not render, and saves it (argument 2).
DRAW_WITH_MUJOCO = """
import sys, mujoco, numpy as np
model = mujoco.MjModel.from_xml_path(sys.argv[1])
data = mujoco.MjData(model)
mujoco.mj_forward(model, data)
with mujoco.Renderer(model, 480, 640) as renderer:
    renderer.update_scene(data, "room")
    for flag in (mujoco.mjtRndFlag.mjRND_HAZE, mujoco.mjtRndFlag.mjRND_REFLECTION):
        renderer.scene.flags[flag] = 0
    np.save(sys.argv[2], renderer.render())
"""


def _draw_with_mujoco(path: Path) -> np.ndarray:
    """Returns u8[H, W, 3]. MuJoCo reads MUJOCO_GL when it is imported, so each library needs a process of its own."""
    for library in ("egl", "osmesa"):
        command = [sys.executable, "-c", DRAW_WITH_MUJOCO, str(EXAMPLE), str(path)]
        environment = os.environ | {"MUJOCO_GL": library}
        if not subprocess.run(command, env=environment, check=False, capture_output=True).returncode:
            return np.load(path)
    pytest.skip("MuJoCo finds neither EGL nor OSMesa")


def test_example_scene_compiles() -> None:
    model = mujoco.MjModel.from_xml_path(str(EXAMPLE))
    assert len(render.compile_scene(model).geom_ids) == model.ngeom


@pytest.mark.slow
def test_colours_equal_mujocos_renderer(tmp_path: Path) -> None:
    expected = _draw_with_mujoco(tmp_path / "picture.npy")
    model = mujoco.MjModel.from_xml_path(str(EXAMPLE))
    data = forward(model)
    frames = render.poses(data)
    scene, eye = render.compile_scene(model), render.camera(frames, model, "room")
    draw = jax.jit(render.render, static_argnames="size")
    image = draw(scene, frames, eye, size=SIZE)
    without_shadows = draw(scene.replace(has_shadows=False), frames, eye, size=SIZE)
    _, ids = cast_image(model, data, 0, SIZE)
    is_shaded = np.abs(np.asarray(image.rgb - without_shadows.rgb)).sum(axis=-1) > 0.01
    is_clear = ~on_outline(ids) & ~on_outline(is_shaded)
    error = np.abs(255.0 * np.asarray(image.rgb) - expected)[is_clear]
    assert error.mean() <= 2.0
