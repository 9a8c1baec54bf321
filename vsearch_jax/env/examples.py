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
from vsearch_jax.config import EncoderConfig
from vsearch_jax.env.task import ViewSearchEnv
from vsearch_jax.geometry import fold_into_band, view_from_uniform, wrap_angle
from vsearch_jax.types import Camera, View
from vsearch_jax.xla.tree import tree_where

_GROUP_SIZE = 4
"""Number of views of a group: one, two neighbours of it, and a neighbour of the view turned by 180 degrees.

A group gives three near pairs, and three of views that often look alike. Pairs of views would give one of either kind
for the same number of images.
"""
_NEIGHBOUR_DEG, _CLEAN_NEIGHBOUR_DEG = (1.5, 8.0), 2.0
"""Standard deviation of the offsets of neighbours, in azimuth and elevation: of augmented views, from the first to the
second value and log-uniform over the groups; and of clean views."""


CLEAN, SHADED, AUGMENTED = range(3)
"""Disturbance of an example. CLEAN: the image as a search sees it. SHADED: that, and shadows of links that an arm might
have. AUGMENTED: random lights, shadows, camera jitter and image augmentation."""


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
    """Draws the views of a batch of B examples, in groups of four.

    For the pose loss a group is a view, uniform over the band, two neighbours of it, and a neighbour of the view turned
    by 180 degrees, which often looks alike. Without pose loss all views are uniform.

    Args:
      key: PRNG key.
      env: the task.
      is_clean: bool[], the views will be clean. Then neighbours are closer, so that many pairs match.

    Returns:
      Views of f32[B] rad.
    """
    config = env.config.encoder
    uniform_key, offset_key, distance_key = jax.random.split(key, 3)
    if config.loss == "autoencoder":
        return view_from_uniform(jax.random.uniform(uniform_key, (2, config.batch_size)), env.reach.band)
    num_groups = -(-config.batch_size // _GROUP_SIZE)
    views = view_from_uniform(jax.random.uniform(uniform_key, (2, num_groups, 1)), env.reach.band)
    nearest, farthest = (math.log(math.radians(degrees)) for degrees in _NEIGHBOUR_DEG)
    std = jnp.exp(jax.random.uniform(distance_key, (num_groups, 1), minval=nearest, maxval=farthest))
    std = jnp.where(is_clean, math.radians(_CLEAN_NEIGHBOUR_DEG), std)
    offset = std[None] * jax.random.normal(offset_key, (2, num_groups, _GROUP_SIZE))
    offset = offset.at[:, :, 0].set(0.0)
    turn = jnp.where(jnp.arange(_GROUP_SIZE) == _GROUP_SIZE - 1, jnp.pi, 0.0)
    azimuth = wrap_angle(views.azimuth + turn[None] + offset[0])
    elevation = fold_into_band(views.elevation + offset[1], env.reach.band)
    return View(azimuth.reshape(-1)[: config.batch_size], elevation.reshape(-1)[: config.batch_size])


def random_disturbances(key: Array, config: EncoderConfig) -> Array:
    """Draws the disturbances of a batch of B examples: i32[B], SHADED or AUGMENTED, equal within a group of four.

    Searches meet the scene's own lights, and there the arm's shadow disturbs the most. On the gear of eval/parts.py, on
    the side where the shadow falls on the object, 74 % of the views 1 to 1.5 degrees apart match with half of the
    examples shaded, 82 % with three quarters, and 92 % with nearer neighbours (`_NEIGHBOUR_DEG`) and a shadow in each.

    Args:
      key: PRNG key.
      config: batch size and `shaded_share`.
    """
    num_groups = -(-config.batch_size // _GROUP_SIZE)
    is_shaded = jax.random.uniform(key, (num_groups,)) < config.shaded_share
    return jnp.repeat(jnp.where(is_shaded, SHADED, AUGMENTED), _GROUP_SIZE)[: config.batch_size]


def encoder_example(key: Array, view: View, disturbance: Array, *, env: ViewSearchEnv) -> EncoderExample:
    """Renders one training example of the encoder from a view, with random joint values of the arm.

    The clean target has no shadows, so the encoder learns to ignore the arm's shadow.

    Args:
      key: PRNG key of joint values, lights, camera jitter and image augmentation.
      view: the view, f32[] rad. If the arm cannot reach it, the nearest reachable view of the map's grid replaces it.
      disturbance: i32[], CLEAN, SHADED or AUGMENTED.
      env: the task. Scene and arm are used, the encoder in it is not.
    """
    pose_key, light_key, shade_key, camera_key, image_key = jax.random.split(key, 5)
    _, qpos, _ = env.resolve_view(view, env.random_joints(pose_key), jnp.bool_(False))
    data, camera = env.forward(qpos)
    object_ids = jnp.asarray(env.scene.object_geom_ids)

    size = env.config.scene.image_size
    lit_scene = encoders.randomize_lights(light_key, env.render_scene, env.center, camera)
    is_augmented = disturbance == AUGMENTED
    lit_scene = tree_where(is_augmented, lit_scene, env.render_scene)
    jittered = tree_where(is_augmented, encoders.jitter_camera(camera_key, camera), camera)
    shade = encoders.draw_shade(shade_key, size) & (disturbance != CLEAN)
    image = render.render(lit_scene, data, jittered, (size, size), shade)
    pixels = encoders.network_input(image, object_ids, env.config)
    inputs = encoders.augment_input(image_key, pixels, render.silhouette(image, env.scene.object_geom_ids), env.config)
    inputs = jnp.where(is_augmented, inputs, pixels)
    target = None if env.config.encoder.loss == "pose" else _clean_target(env, data, camera)
    return EncoderExample(inputs, target, camera.rotation)


def _clean_target(env: ViewSearchEnv, data: mjx.Data, camera: Camera) -> Array:
    """Returns the image f32[h, w, C] in [0, 1] that the decoder must reproduce: the object without shadows."""
    size = env.config.encoder.decoder_size
    clean = render.render(dataclasses.replace(env.render_scene, has_shadows=False), data, camera, (size, size))
    pixels = encoders.network_input(clean, jnp.asarray(env.scene.object_geom_ids), env.config)
    return encoders.clean_target(pixels, render.silhouette(clean, env.scene.object_geom_ids), env.config)
