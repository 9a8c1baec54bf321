"""Training examples of the encoder: random views of the task, augmented, and clean for the decoder."""

from __future__ import annotations

import dataclasses
import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from mujoco import mjx

from vsearch_jax import encoder as encoders
from vsearch_jax import render
from vsearch_jax.env.task import ViewSearchEnv
from vsearch_jax.geometry import fold_into_band, view_from_uniform, wrap_angle
from vsearch_jax.types import Camera, View
from vsearch_jax.xla.tree import tree_where

_NEIGHBOUR_DEG, _CLEAN_NEIGHBOUR_DEG = 8.0, 2.0
"""Standard deviation of the offsets of neighbours, in azimuth and elevation: augmented views, and clean views."""


class EncoderExample(NamedTuple):
    """One training example of the encoder. Images have C channels.

    Attributes:
      inputs: f32[H, W, C] in [0, 1], augmented image, `scene.image_size` high and wide.
      target: f32[h, w, C] in [0, 1], clean image, `encoder.decoder_size` high and wide. None without a decoder.
      rotation: f32[3, 3], rotation of the camera, camera to world, before the jitter.
    """

    inputs: Array
    target: Array | None
    rotation: Array


def random_example_views(key: Array, env: ViewSearchEnv, is_clean: Array) -> View:
    """Draws the views of a batch of B examples: one half uniform over the band, the other half their partners.

    For the pose loss half of the partners are neighbours of their view. The other half are neighbours of the view
    turned by 180 degrees, which often looks alike. Without pose loss all views are uniform.

    Args:
      key: PRNG key.
      env: the task.
      is_clean: bool[], the views will be clean. Then neighbours are closer, so that many pairs match.

    Returns:
      Views of f32[B] rad.
    """
    config = env.config.encoder
    uniform_key, offset_key = jax.random.split(key)
    views = view_from_uniform(jax.random.uniform(uniform_key, (2, config.batch_size)), env.reach.band)
    if config.loss == "autoencoder":
        return views
    half = config.batch_size // 2
    std = jnp.where(is_clean, math.radians(_CLEAN_NEIGHBOUR_DEG), math.radians(_NEIGHBOUR_DEG))
    offset = std * jax.random.normal(offset_key, (2, half))
    turn = jnp.where(jnp.arange(half) < half // 2, 0.0, jnp.pi)
    first = jax.tree.map(lambda x: x[: config.batch_size - half], views)
    partners = View(
        wrap_angle(first.azimuth[:half] + turn + offset[0]),
        fold_into_band(first.elevation[:half] + offset[1], env.reach.band),
    )
    return jax.tree.map(lambda *x: jnp.concatenate(x), first, partners)


def encoder_example(key: Array, view: View, is_clean: Array, *, env: ViewSearchEnv) -> EncoderExample:
    """Renders one training example of the encoder from a view, with random joint values of the arm.

    The clean target has no shadows, so the encoder learns to ignore the arm's shadow.

    Args:
      key: PRNG key of joint values, lights, camera jitter and image augmentation.
      view: the view, f32[] rad. If the arm cannot reach it, the nearest reachable view of the map's grid replaces it.
      is_clean: bool[], the input is the image as a search sees it, without random lights, jitter and augmentation.
      env: the task. Scene and arm are used, the encoder in it is not.
    """
    pose_key, light_key, shade_key, camera_key, image_key = jax.random.split(key, 5)
    _, qpos, _ = env.resolve_view(view, env.random_joints(pose_key), jnp.bool_(False))
    data, camera = env.forward(qpos)
    object_ids = jnp.asarray(env.scene.object_geom_ids)

    size = env.config.scene.image_size
    lit_scene = encoders.randomize_lights(light_key, env.render_scene, env.center, camera)
    lit_scene = tree_where(is_clean, env.render_scene, lit_scene)
    jittered = tree_where(is_clean, camera, encoders.jitter_camera(camera_key, camera))
    shade = encoders.draw_shade(shade_key, size) & ~is_clean
    image = render.render(lit_scene, data, jittered, (size, size), shade)
    pixels = encoders.network_input(image, object_ids, env.config)
    inputs = encoders.augment_input(image_key, pixels, render.silhouette(image, env.scene.object_geom_ids), env.config)
    inputs = jnp.where(is_clean, pixels, inputs)
    target = None if env.config.encoder.loss == "pose" else _clean_target(env, data, camera)
    return EncoderExample(inputs, target, camera.rotation)


def _clean_target(env: ViewSearchEnv, data: mjx.Data, camera: Camera) -> Array:
    """Returns the image f32[h, w, C] in [0, 1] that the decoder must reproduce: the object without shadows."""
    size = env.config.encoder.decoder_size
    clean = render.render(dataclasses.replace(env.render_scene, has_shadows=False), data, camera, (size, size))
    pixels = encoders.network_input(clean, jnp.asarray(env.scene.object_geom_ids), env.config)
    return encoders.clean_target(pixels, render.silhouette(clean, env.scene.object_geom_ids), env.config)
