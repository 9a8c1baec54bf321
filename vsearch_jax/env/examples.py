"""Training examples of the encoder: random views of the task, augmented and clean."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
from jax import Array

from vsearch_jax import encoder as encoders
from vsearch_jax import render
from vsearch_jax.env.task import ViewSearchEnv


def encoder_example(key: Array, *, env: ViewSearchEnv) -> tuple[Array, Array]:
    """Renders one training example of the encoder: a random view as augmented input and as clean target image.

    The arm has random joint values. The target has no shadows, so the encoder learns to ignore the arm's shadow.

    Args:
      key: PRNG key of view, joint values, lights, camera jitter and image augmentation.
      env: the task. Scene and arm are used, the encoder in it is not.

    Returns:
      Input image f32[H, W, C] in [0, 1], `scene.image_size` high and wide, and target image f32[h, w, C] in [0, 1],
      `encoder.decoder_size` high and wide. C is the number of channels.
    """
    pose_key, light_key, camera_key, image_key = jax.random.split(key, 4)
    _, qpos = env.random_pose(pose_key)
    data, camera = env.forward(qpos)
    object_ids = jnp.asarray(env.scene.object_geom_ids)

    size, decoder_size = env.config.scene.image_size, env.config.encoder.decoder_size
    lit_scene = encoders.randomize_lights(light_key, env.render_scene, env.center)
    image = render.render(lit_scene, data, encoders.jitter_camera(camera_key, camera), (size, size))
    pixels = encoders.network_input(image, object_ids, env.config)
    inputs = encoders.augment_input(image_key, pixels, render.silhouette(image, env.scene.object_geom_ids), env.config)

    clean_scene = dataclasses.replace(env.render_scene, has_shadows=False)
    clean = render.render(clean_scene, data, camera, (decoder_size, decoder_size))
    pixels = encoders.network_input(clean, object_ids, env.config)
    targets = encoders.clean_target(pixels, render.silhouette(clean, env.scene.object_geom_ids), env.config)
    return inputs, targets
