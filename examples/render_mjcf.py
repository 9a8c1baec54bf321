"""Draws a camera of any MJCF: `python examples/render_mjcf.py examples/workshop.xml room docs/workshop.png`."""

import sys

import jax
import matplotlib.image
import mujoco
import numpy as np
from mujoco import mjx

from vsearch_jax import render


def main(mjcf: str, camera_name: str, picture: str) -> None:
    """Draws what the camera `camera_name` of the file `mjcf` sees in the model's initial pose."""
    model = mujoco.MjModel.from_xml_path(mjcf)
    scene = render.compile_scene(model)
    data = mjx.kinematics(mjx_model := mjx.put_model(model), mjx.make_data(mjx_model))
    data = mjx.camlight(mjx_model, mjx.com_pos(mjx_model, data))
    camera = render.camera(data, model, camera_name)
    image = jax.jit(render.supersample, static_argnames=("size", "factor"))(
        scene, data, camera, size=(480, 640), factor=3
    )
    matplotlib.image.imsave(picture, np.asarray(image.rgb))


if __name__ == "__main__":
    main(*sys.argv[1:])
