"""Domain randomisation: lights, camera and image stay within the documented limits and depend on the key."""

from __future__ import annotations

import dataclasses
import functools
from typing import Literal

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from vsearch_jax import encoder as encoders
from vsearch_jax.config import PRESETS, Config
from vsearch_jax.encoder import augment, network
from vsearch_jax.render import compile_scene
from vsearch_jax.render.lights import Lights
from vsearch_jax.render.scene import RenderScene
from vsearch_jax.types import Camera

INPUTS = ("rgb", "depth", "silhouette")
CENTER = np.array([0.0, 0.0, 0.05], np.float32)
LIT_MODEL = """
<mujoco>
  <worldbody>
    <light pos="0.9 -0.7 1.3" dir="-0.9 0.7 -1.3" type="directional" diffuse="0.6 0.5 0.4" specular="0.4 0.4 0.4"/>
    <light pos="0 0 2" diffuse="0.2 0.2 0.2"/>
    <geom type="sphere" size="0.05"/>
  </worldbody>
</mujoco>
"""


def _config(kind: Literal["rgb", "depth", "silhouette"]) -> Config:
    smoke = PRESETS["smoke"]
    return dataclasses.replace(smoke, encoder=dataclasses.replace(smoke.encoder, input=kind))


@pytest.mark.parametrize("kind", INPUTS)
def test_augmented_inputs_depend_on_the_key_and_stay_in_range(kind):
    config = _config(kind)
    off, on = (0.0, 1.0) if kind == "silhouette" else (0.3, 0.7)
    x = jnp.full((32, 32, network.in_features(config.encoder)), off).at[8:24, 8:24].set(on)
    keys = jax.random.split(jax.random.key(0), 64)
    apply = jax.jit(jax.vmap(lambda key: encoders.augment_input(key, x, x[..., 0] > 0.5, config)))
    inputs = apply(keys)
    assert inputs.shape == (64, *x.shape)
    assert np.all((inputs >= 0.0) & (inputs <= 1.0))
    assert len(np.unique(np.asarray(inputs).reshape(64, -1), axis=0)) == 64
    np.testing.assert_array_equal(apply(keys), inputs)
    if kind == "silhouette":
        assert set(np.unique(inputs)) == {0.0, 1.0}


def test_half_of_the_backgrounds_are_replaced_and_the_object_is_kept():
    x = jnp.full((16, 16, 3), 0.5)
    is_object = jnp.zeros((16, 16), bool).at[4:12, 4:12].set(True)
    keys = jax.random.split(jax.random.key(0), 400)
    images = jax.vmap(augment.replace_background, in_axes=(0, None, None))(keys, x, is_object)
    assert np.all(images[:, 4:12, 4:12] == 0.5)
    is_replaced = np.any(images != 0.5, axis=(1, 2, 3))
    assert abs(is_replaced.mean() - 0.5) < 4 * 0.5 / np.sqrt(400)  # Four standard deviations.
    assert np.all(np.any(images[is_replaced] != 0.5, axis=-1)[:, ~is_object])


def test_shade_covers_a_part_of_each_image():
    draw = jax.jit(jax.vmap(augment.draw_shade, in_axes=(0, None)), static_argnums=1)
    share = np.asarray(draw(jax.random.split(jax.random.key(0), 400), 32)).mean(axis=(1, 2))
    assert (share > 0.0).all()
    assert 0.1 < share.mean() < 0.6
    assert share.std() > 0.05


def test_colour_matrix_keeps_grey_and_limits_the_hue():
    matrices = jax.vmap(augment._color_matrix)(jax.random.split(jax.random.key(0), 100))
    np.testing.assert_allclose(jnp.full(3, 0.4) @ matrices, 0.4, atol=1e-6)
    red = np.array([1.0, -0.5, -0.5])
    rotated = red @ np.asarray(matrices)
    cosine = rotated @ red / np.linalg.norm(rotated, axis=-1) / np.linalg.norm(red)
    assert np.all(cosine >= np.cos(augment._MAX_HUE) - 1e-5)
    assert cosine.min() < np.cos(0.8 * augment._MAX_HUE)


def _random_lights(scene: RenderScene, count: int) -> Lights:
    keys = jax.random.split(jax.random.key(0), count)
    camera = Camera(position=CENTER + jnp.array([0.3, 0.0, 0.1]), rotation=jnp.eye(3), fovy=jnp.float32(0.6))
    randomize = functools.partial(encoders.randomize_lights, scene=scene, center=jnp.asarray(CENTER), camera=camera)
    return jax.jit(jax.vmap(randomize))(keys).lights


def test_random_lights_keep_their_distance_and_shine_at_the_centre_from_above(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(augment, "_BEHIND_PROBABILITY", 0.0)
    scene = compile_scene(mujoco.MjModel.from_xml_string(LIT_MODEL))
    lights = _random_lights(scene, 50)
    offset = np.asarray(lights.position) - CENTER
    distance = np.linalg.norm(offset, axis=-1)
    np.testing.assert_allclose(
        distance, np.tile(np.linalg.norm(np.asarray(scene.lights.position) - CENTER, axis=-1), (50, 1)), rtol=1e-5
    )
    np.testing.assert_allclose(lights.direction, -offset / distance[..., None], atol=1e-5)
    height = -np.asarray(lights.direction)[..., 2]
    assert np.all(height > 0.499)
    assert height.min() < 0.55
    assert abs(height.mean() - 0.75) < 0.06  # Over the cap, the height is uniform from 1/2 to 1.
    ratio = np.asarray(lights.diffuse) / np.asarray(scene.lights.diffuse)
    assert np.all((ratio > 0.4 * 0.85 - 1e-5) & (ratio < 1.3 * 1.15 + 1e-5))


def test_most_images_are_lit_from_behind_the_camera_and_above_the_table():
    scene = compile_scene(mujoco.MjModel.from_xml_string(LIT_MODEL))
    lights = _random_lights(scene, 400)
    offset = np.asarray(lights.position) - CENTER
    assert np.all(offset[..., 2] > 0.0)
    from_light = -np.asarray(lights.direction)
    np.testing.assert_allclose(np.linalg.norm(from_light, axis=-1), 1.0, atol=1e-5)
    # Behind the camera: within 60 degrees of its direction, three standard deviations of the spread. By chance a light
    # of the others is there too; that both are is rare.
    is_behind = np.all(from_light @ np.array([0.3, 0.0, 0.1]) / np.sqrt(0.1) > 0.5, axis=-1)
    assert 0.55 < is_behind.mean() < 0.75


def test_jittered_camera_keeps_its_position_and_tilts_within_the_limit():
    camera = Camera(position=jnp.array([0.1, 0.2, 0.3]), rotation=jnp.eye(3), fovy=jnp.float32(0.6))
    jittered = jax.vmap(encoders.jitter_camera, in_axes=(0, None))(jax.random.split(jax.random.key(0), 200), camera)
    np.testing.assert_array_equal(jittered.position, np.tile(camera.position, (200, 1)))
    np.testing.assert_allclose(
        jittered.rotation @ jnp.swapaxes(jittered.rotation, 1, 2), np.tile(np.eye(3), (200, 1, 1)), atol=1e-6
    )
    tilt = np.arccos(np.clip(jittered.rotation[:, 2, 2], -1.0, 1.0))
    assert 0.04 * 0.6 < tilt.max() <= 0.05 * 0.6 * np.sqrt(2) + 1e-4
    assert np.all((jittered.fovy > 0.6 * 0.919) & (jittered.fovy < 0.6 * 1.081))


def test_clean_target_shows_only_the_object():
    is_object = jnp.array([[True, False]])
    for kind, blank in zip(INPUTS, (0.0, 1.0, 0.0), strict=True):
        config = _config(kind)
        x = jnp.full((1, 2, network.in_features(config.encoder)), 0.5)
        target = encoders.clean_target(x, is_object, config)
        assert np.all(target[0, 0] == 0.5)
        assert np.all(target[0, 1] == blank)
