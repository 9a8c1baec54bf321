"""Draws every object of the package as the wrist camera sees it: `python eval/views.py docs/views.png`."""

from __future__ import annotations

import dataclasses
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

import vsearch_jax as vs
from vsearch_jax.cli.errors import one_line_errors
from vsearch_jax.scene import available
from vsearch_jax.types import View

AZIMUTHS_DEG = np.arange(0, 360, 45)


def wrist_images(name: str) -> np.ndarray:
    """Returns f32[8, H, W, 3], images of one object at eight azimuths, at the middle elevation of the arm's band."""
    config = vs.Config.preset("cpu")
    env = vs.ViewSearchEnv(dataclasses.replace(config, scene=dataclasses.replace(config.scene, object=name)))
    elevation = jnp.mean(env.reach.band)

    def wrist_image(azimuth: jax.Array) -> jax.Array:
        qpos, _ = env.solve_joints(View(azimuth, elevation), env.arm.home)
        return env.wrist_image(qpos)[1].rgb

    return np.asarray(jax.jit(jax.vmap(wrist_image))(jnp.deg2rad(AZIMUTHS_DEG.astype(np.float32))))


def main(path: str) -> None:
    """Writes the picture to `path`, a PNG file: one row for each object, one column for each azimuth."""
    names = available("objects")
    num_columns, num_rows = len(AZIMUTHS_DEG), len(names)
    figure = Figure(figsize=(num_columns, num_rows), dpi=128)
    for row, name in enumerate(names):
        for column, image in enumerate(wrist_images(name)):
            axes = figure.add_axes((column / num_columns, 1 - (row + 1) / num_rows, 1 / num_columns, 1 / num_rows))
            axes.imshow(np.clip(image, 0, 1))
            axes.set_axis_off()
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, format="png")


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit("usage: python eval/views.py PICTURE, for example docs/views.png")
    with one_line_errors():
        main(sys.argv[1])
