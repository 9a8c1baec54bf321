"""The soft silhouette against a sphere's exact projection, and the square crop."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from oracles.render import forward, poses
from vsearch_jax import render

BALL = """
<mujoco><worldbody>
  <geom name="ball" size=".3"/>
  <geom type="plane" size="0 0 1" pos="0 0 -1"/>
  <camera name="eye" pos="0 0 2" fovy="50"/>
</worldbody></mujoco>
"""
SIZE = (128, 128)
FOCAL_LENGTH = 64 / np.tan(np.deg2rad(25))  # pixels


def test_derivatives_of_the_soft_silhouette_follow_the_outline() -> None:
    model = mujoco.MjModel.from_xml_string(BALL)
    frames, scene = poses(model, forward(model)), render.compile_scene(model)
    eye = render.camera(frames, model, "eye")

    def area(height: jax.Array) -> jax.Array:
        camera = eye.replace(position=jnp.stack([jnp.float32(0.05), jnp.float32(0.02), height]))
        return jnp.sum(render.soft_silhouette(scene, frames, camera, SIZE, (0,)))

    def exact_area(height: float) -> float:
        """Returns the area of the ball's projection, taken as a circle."""
        return np.pi * (FOCAL_LENGTH * 0.3 / np.sqrt(height**2 - 0.09)) ** 2

    value, slope = jax.jit(jax.value_and_grad(area))(jnp.float32(1.6))
    assert float(value) == pytest.approx(exact_area(1.6), rel=0.03)
    assert float(slope) == pytest.approx((exact_area(1.601) - exact_area(1.599)) / 0.002, rel=0.1)

    def mean_column(x: jax.Array) -> jax.Array:
        moved = frames._replace(geom_xpos=jnp.asarray(frames.geom_xpos).at[0, 0].set(x))
        mask = render.soft_silhouette(scene, moved, eye, SIZE, (0,))
        return jnp.sum(mask * jnp.arange(128.0)[None]) / jnp.sum(mask)

    rate = jax.jit(jax.grad(mean_column))(jnp.float32(0.0))
    assert float(rate) == pytest.approx(FOCAL_LENGTH / 2.0, rel=0.1)


def test_crop_is_the_square_around_the_object() -> None:
    pixels = np.zeros((40, 60, 3), np.float32)
    pixels[10:20, 30:50] = [0.2, 0.6, 1.0]
    square = render.square_around(jnp.asarray(pixels[..., 0] > 0), margin=0.0)
    assert (float(square.row), float(square.column), float(square.edge)) == (15.0, 40.0, 20.0)
    part = np.asarray(render.crop(jnp.asarray(pixels), square, 40))
    np.testing.assert_allclose(part[12:28, 2:38], np.broadcast_to([0.2, 0.6, 1.0], (16, 36, 3)), atol=1e-5)
    assert not part[:8].any() and not part[32:].any()
    empty = render.square_around(jnp.zeros((40, 60), bool))
    assert (float(empty.row), float(empty.column), float(empty.edge)) == (20.0, 30.0, 40.0)
