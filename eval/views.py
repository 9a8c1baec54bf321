"""Draws what the wrist camera sees around every object of the package: `python eval/views.py docs/views.png`."""

import dataclasses
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

import vsearch_jax as vs
from vsearch_jax.scene import available
from vsearch_jax.types import View

AZIMUTHS_DEG = np.arange(0, 360, 45)


def views(name: str) -> np.ndarray:
    """Returns f32[8, H, W, 3]: the object from eight sides, from the middle of what the arm can reach."""
    config = vs.Config.preset("cpu")
    env = vs.ViewSearchEnv(dataclasses.replace(config, scene=dataclasses.replace(config.scene, object=name)))
    elevation = jnp.mean(env.reach.band)

    def picture(azimuth: jax.Array) -> jax.Array:
        qpos, _ = env.solve_joints(View(azimuth, elevation), env.arm.home)
        return env.wrist_image(qpos)[1].rgb

    return np.asarray(jax.jit(jax.vmap(picture))(jnp.deg2rad(AZIMUTHS_DEG.astype(np.float32))))


def main(path: str) -> None:
    """Writes the picture to `path`."""
    names = available("objects")
    figure = Figure(figsize=(len(AZIMUTHS_DEG), len(names)), dpi=128)
    for row, name in enumerate(names):
        for column, image in enumerate(views(name)):
            axes = figure.add_axes((column / len(AZIMUTHS_DEG), 1 - (row + 1) / len(names), 1 / 8, 1 / len(names)))
            axes.imshow(np.clip(image, 0, 1))
            axes.set_axis_off()
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path)


if __name__ == "__main__":
    main(sys.argv[1])
