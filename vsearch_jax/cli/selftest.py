"""Self-test of the renderer: renders a small scene and compares it with a stored image. Needs no display and no GL."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import jax
import mujoco
import numpy as np

from vsearch_jax import render

REFERENCE = Path(__file__).with_name("selftest.npz")
"""The stored image. To make it again: `python -c "from vsearch_jax.cli import selftest; selftest.make_reference()"`."""

SIZE = (32, 32)
"""Height and width of the image in pixels."""

# A geom of each kind: primitives, whose hits have closed forms, and a mesh, which is rasterised.
_SCENE = """
<mujoco>
  <asset>
    <mesh name="pyramid" vertex="-.15 -.15 0  .15 -.15 0  .15 .15 0  -.15 .15 0  0 0 .3"/>
  </asset>
  <worldbody>
    <light pos="1 -1 2" dir="-1 1 -2" directional="true" castshadow="true"/>
    <geom type="plane" size="2 2 .1" rgba=".7 .7 .6 1"/>
    <geom type="sphere" size=".2" pos="-.5 0 .2" rgba=".8 .2 .2 1"/>
    <geom type="box" size=".15 .15 .2" pos="0 .4 .2" euler="0 0 30" rgba=".2 .4 .8 1"/>
    <geom type="capsule" size=".1 .2" pos=".5 .1 .1" euler="90 0 40" rgba=".2 .7 .3 1"/>
    <geom type="cylinder" size=".12 .25" pos="-.15 -.4 .25" rgba=".8 .7 .2 1"/>
    <geom type="mesh" mesh="pyramid" pos=".4 -.45 0.1" rgba=".6 .3 .7 1"/>
    <camera name="eye" pos="0 -1.6 1.4" xyaxes="1 0 0 0 .66 .75" fovy="50"/>
  </worldbody>
</mujoco>
"""

_MAX_COLOR_DIFFERENCE = 3 / 255
_MAX_PIXELS = 10
"""Pixels that may differ: platforms round differently, and at an edge that decides which geom a pixel shows."""


_render = jax.jit(render.render, static_argnames="size")


class _Pixels(NamedTuple):
    """The compared parts of an image: rgb f32[H, W, 3] in [0, 1] and geom_id i32[H, W]."""

    rgb: np.ndarray
    geom_id: np.ndarray


def load_scene() -> tuple[mujoco.MjModel, mujoco.MjData]:
    """Loads the scene of the renderer's self-test: its model, and its data after `mj_forward`. The camera is "eye"."""
    model = mujoco.MjModel.from_xml_string(_SCENE)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return model, data


def make_reference(path: Path = REFERENCE) -> None:
    """Renders the scene of the self-test, and stores the image with which later self-tests compare.

    Args:
      path: the .npz file, with `rgb` u8[H, W, 3] and `geom_id` i8[H, W].
    """
    pixels = _render_scene()
    rgb = np.round(255 * pixels.rgb).astype(np.uint8)
    np.savez_compressed(path, rgb=rgb, geom_id=pixels.geom_id.astype(np.int8))


def find_difference(path: Path = REFERENCE) -> str | None:
    """Tests the renderer: renders the scene of the self-test and compares it with the stored image.

    Args:
      path: file that `make_reference` wrote.

    Returns:
      None if the images agree, otherwise a line that names the difference.

    Raises:
      OSError: the file cannot be read.
    """
    pixels = _render_scene()
    with np.load(path) as stored:
        reference = _Pixels(stored["rgb"] / 255.0, stored["geom_id"])
    has_other_id = pixels.geom_id != reference.geom_id
    color_difference = np.abs(pixels.rgb - reference.rgb).max(axis=-1)
    # A comparison with NaN is false, so NaN counts as different.
    has_other_color = ~(color_difference <= _MAX_COLOR_DIFFERENCE)
    if max(has_other_id.sum(), has_other_color.sum()) <= _MAX_PIXELS:
        return None
    return (
        f"{has_other_id.sum()} of {has_other_id.size} pixels show another geom, {has_other_color.sum()} have another "
        f"colour (largest difference {color_difference.max():.3f}); allowed: {_MAX_PIXELS} pixels of each"
    )


def _render_scene() -> _Pixels:
    model, data = load_scene()
    poses, scene = render.poses(data), render.compile_scene(model)
    camera = render.camera(poses, model, "eye")
    image = _render(scene, poses, camera, size=SIZE)
    return _Pixels(np.asarray(image.rgb), np.asarray(image.geom_id))
