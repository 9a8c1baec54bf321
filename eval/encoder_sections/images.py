"""Codes of clean and of disturbed views, for one encoder."""

from __future__ import annotations

import functools
from typing import NamedTuple

import dm_pix
import jax
import jax.numpy as jnp
from jax import Array

import vsearch_jax as vs
from vsearch_jax import encoder as encoders
from vsearch_jax import render
from vsearch_jax.config import Config
from vsearch_jax.geometry import view_from_uniform
from vsearch_jax.training import encoder_iteration, fill_pool
from vsearch_jax.types import Camera, EncoderState, ReachabilityMap, View
from vsearch_jax.xla.batching import map_in_batches
from vsearch_jax.xla.tree import tree_where

DISTURBANCES = ("none", "arm", "light", "occlusion", "shift", "noise", "blur")
"""`arm` has random arm configurations; the others, `none` included, have one configuration for each view."""
_BATCH = 64
_OCCLUDED_SIDE, _NOISE_STD, _BLUR_STD = 0.3, 0.05, 1.5
"""Side of the occluding square as a part of the image; noise of a channel in [0, 1]; blur in pixels."""


class Sizes(NamedTuple):
    """How much is measured.

    Attributes:
      azimuths: number of azimuths of the grid of clean views.
      elevations: number of elevations of the grid.
      views: number of views that are disturbed.
      draws: number of disturbances of each kind and view.
    """

    azimuths: int
    elevations: int
    views: int
    draws: int


FULL = Sizes(180, 11, 24, 50)
QUICK = Sizes(12, 3, 2, 4)


class Codes(NamedTuple):
    """Codes of one encoder.

    Attributes:
      grid: f32[A, E, Z], codes of clean views on a grid over the band, each with another arm configuration.
      grid_camera: cameras of the grid, leading axes [A, E].
      disturbed: {kind: f32[V, D, Z]}, codes of V views with D disturbances each.
    """

    grid: Array
    grid_camera: Camera
    disturbed: dict[str, Array]


@functools.partial(jax.jit, static_argnames="config")
def train_encoder(key: Array, reach: ReachabilityMap, config: Config) -> EncoderState:
    """Trains an encoder as `vsearch_jax.train` does, without a policy.

    Args:
      key: PRNG key.
      reach: the views that the arm reaches.
      config: the run's config.

    Returns:
      The trained encoder.
    """
    init_key, train_key, pool_key = jax.random.split(key, 3)
    start = encoders.init(init_key, config)
    env = vs.ViewSearchEnv(config, start, reach)

    def update(i: Array, encoder: EncoderState) -> EncoderState:
        return encoder_iteration(i, encoder, env=env, key=train_key)[0]

    trained = jax.lax.fori_loop(0, config.encoder.num_updates, update, start)
    if config.encoder.loss == "pose":  # without whitening, which needs the pool's images
        return trained
    return fill_pool(pool_key, vs.ViewSearchEnv(config, trained, reach))[0]


@functools.partial(jax.jit, static_argnames=("config", "sizes"))
def encode_views(key: Array, encoder: EncoderState, reach: ReachabilityMap, config: Config, sizes: Sizes) -> Codes:
    """Renders and encodes all views that are measured.

    Args:
      key: PRNG key of arm configurations, views and disturbances.
      encoder: trained encoder.
      reach: the views that the arm reaches.
      config: the run's config.
      sizes: how much is measured.

    Returns:
      The codes, and the cameras of their views.
    """
    env = vs.ViewSearchEnv(config, encoder, reach)
    grid_key, view_key, draw_key = jax.random.split(key, 3)
    middles = (
        jnp.arange(sizes.azimuths, dtype=jnp.float32) / sizes.azimuths,
        jnp.linspace(0.0, 1.0, sizes.elevations),
    )
    grid = view_from_uniform(jnp.stack(jnp.meshgrid(*middles, indexing="ij")), reach.band)
    views = view_from_uniform(jax.random.uniform(view_key, (2, sizes.views)), reach.band)
    shape = (sizes.views, len(DISTURBANCES), sizes.draws)
    repeated = jax.tree.map(lambda x: jnp.broadcast_to(x[:, None, None], shape).ravel(), views)
    kinds = jnp.broadcast_to(jnp.arange(len(DISTURBANCES))[None, :, None], shape).ravel()
    owners = jnp.broadcast_to(jnp.arange(sizes.views)[:, None, None], shape).ravel()

    flat = jax.tree.map(jnp.ravel, grid)
    num_grid = flat.azimuth.size
    keys = jnp.concatenate([jax.random.split(grid_key, num_grid), jax.random.split(draw_key, kinds.size)])
    items = (
        keys,
        jax.tree.map(lambda *x: jnp.concatenate(x), flat, repeated),
        jnp.concatenate([jnp.zeros(num_grid, jnp.int32), kinds]),
        jnp.concatenate([jnp.full(num_grid, -1), owners]),
    )
    camera, codes = map_in_batches(functools.partial(_encode, env, view_key), items, _BATCH)
    disturbed = codes[num_grid:].reshape(*shape, -1)
    grid_shape = (sizes.azimuths, sizes.elevations)
    return Codes(
        grid=codes[:num_grid].reshape(*grid_shape, -1),
        grid_camera=jax.tree.map(lambda x: x[:num_grid].reshape(*grid_shape, *x.shape[1:]), camera),
        disturbed={name: disturbed[:, i] for i, name in enumerate(DISTURBANCES)},
    )


def _encode(env: vs.ViewSearchEnv, joints_key: Array, item: tuple[Array, View, Array, Array]) -> tuple[Camera, Array]:
    """Returns the undisturbed camera and the code f32[Z] of one view; `item` is key, view, kind and owner."""
    key, view, kind, owner = item
    pose_key, light_key, camera_key, image_key = jax.random.split(key, 4)
    # Disturbances other than the arm's compare images of one arm configuration for each view.
    is_fixed = (owner >= 0) & (kind != DISTURBANCES.index("arm"))
    own_key = jax.random.fold_in(joints_key, owner)
    wanted = jnp.where(is_fixed, env.random_joints(own_key), env.random_joints(pose_key))
    _, qpos, _ = env.resolve_view(view, wanted, jnp.bool_(False))
    data, camera = env.forward(qpos)

    lit = encoders.randomize_lights(light_key, env.render_scene, env.center, camera)
    scene = tree_where(kind == DISTURBANCES.index("light"), lit, env.render_scene)
    moved = encoders.jitter_camera(camera_key, camera)
    seen = tree_where(kind == DISTURBANCES.index("shift"), moved, camera)
    size = env.config.scene.image_size
    pixels = encoders.network_input(
        render.render(scene, data, seen, (size, size)), jnp.asarray(env.scene.object_geom_ids), env.config
    )
    disturbed = jax.lax.switch(
        kind,
        [_BY_KIND.get(name, _unchanged) for name in DISTURBANCES],
        image_key,
        pixels,
    )
    latent = encoders.raw_latent(env.encoder.params, disturbed, env.config)
    return camera, encoders.code_of(env.encoder, latent)


def _unchanged(key: Array, pixels: Array) -> Array:
    del key
    return pixels


def _occlude(key: Array, pixels: Array) -> Array:
    """Returns the image f32[H, W, C] with a grey square at a random place."""
    side = _OCCLUDED_SIDE * pixels.shape[0]
    corner = jax.random.uniform(key, (2,)) * (pixels.shape[0] - side)
    offset = jnp.arange(pixels.shape[0])[:, None] - corner[None]
    is_inside = (offset >= 0.0) & (offset < side)
    return jnp.where((is_inside[:, 0][:, None] & is_inside[:, 1][None])[..., None], 0.5, pixels)


def _add_noise(key: Array, pixels: Array) -> Array:
    return jnp.clip(pixels + _NOISE_STD * jax.random.normal(key, pixels.shape), 0.0, 1.0)


def _blur(key: Array, pixels: Array) -> Array:
    del key
    return jnp.asarray(dm_pix.gaussian_blur(pixels, _BLUR_STD, kernel_size=9.0))


_BY_KIND = {"occlusion": _occlude, "noise": _add_noise, "blur": _blur}
