"""Renders a camera of any MJCF file: `python examples/render_mjcf.py examples/workshop.xml room docs/workshop.png`."""

import sys

import jax
import matplotlib.image
import mujoco
import numpy as np

from vsearch_jax import render
from vsearch_jax.cli.errors import one_line_errors


def main(mjcf: str, camera: str, picture: str) -> None:
    """Renders the model in its initial pose.

    Args:
      mjcf: path of the MJCF file.
      camera: name of a camera of the model.
      picture: path of the PNG file to write.
    """
    try:
        model = mujoco.MjModel.from_xml_path(mjcf)
    except ValueError as error:
        sys.exit(f"error: {mjcf} cannot be loaded: {' '.join(str(error).split())}")
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    scene, poses = render.compile_scene(model), render.poses(data)
    draw = jax.jit(render.supersample, static_argnames=("size", "factor"))
    image = draw(scene, poses, render.camera(poses, model, camera), size=(480, 640), factor=3)
    matplotlib.image.imsave(picture, np.asarray(image.rgb), format="png")


if __name__ == "__main__":
    if len(sys.argv) != 4:
        sys.exit("usage: python examples/render_mjcf.py MJCF CAMERA PICTURE")
    with one_line_errors():
        main(*sys.argv[1:])
