"""The views of the encoder's training examples."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vsearch_jax as vs
from vsearch_jax import encoder as encoders
from vsearch_jax.config import Config
from vsearch_jax.env import AUGMENTED, CLEAN, SHADED, encoder_example, random_disturbances, random_example_views
from vsearch_jax.types import View

BAND_DEG = (40.0, 70.0)


def views_deg(loss: str, batch_size: int, is_clean: bool, count: int = 100) -> tuple[np.ndarray, np.ndarray]:
    """Returns azimuths and elevations in degrees of some batches, f64[count, batch_size] each."""
    config = Config.preset("smoke")
    config = dataclasses.replace(config, encoder=dataclasses.replace(config.encoder, loss=loss, batch_size=batch_size))
    env: Any = SimpleNamespace(config=config, reach=SimpleNamespace(band=jnp.deg2rad(jnp.asarray(BAND_DEG))))
    keys = jax.random.split(jax.random.key(0), count)
    views = jax.vmap(lambda key: random_example_views(key, env, jnp.bool_(is_clean)))(keys)
    return np.rad2deg(np.asarray(views.azimuth, np.float64)), np.rad2deg(np.asarray(views.elevation, np.float64))


@pytest.mark.parametrize("batch_size", [8, 10])
@pytest.mark.parametrize("is_clean", [True, False])
def test_a_group_holds_two_neighbours_of_a_view_and_one_of_the_view_turned_by_180_degrees(batch_size, is_clean):
    azimuth, elevation = views_deg("pose", batch_size, is_clean)
    assert azimuth.shape == elevation.shape == (100, batch_size)
    assert elevation.min() >= BAND_DEG[0] - 1e-3 and elevation.max() <= BAND_DEG[1] + 1e-3
    first, others = azimuth[:, :1], azimuth[:, 1:4] - np.array([0.0, 0.0, 180.0])
    apart = (others - first + 180.0) % 360.0 - 180.0
    spread = np.sqrt(np.mean(apart**2, axis=0))
    low, high = (1.6, 2.4) if is_clean else (3.0, 6.0)  # others: the root mean square of 1.5 to 8 degrees is 4.3
    assert ((spread > low) & (spread < high)).all(), spread
    groups_apart = (azimuth[:, 4] - azimuth[:, 0] + 180.0) % 360.0 - 180.0
    assert np.sqrt(np.mean(groups_apart**2)) > 60.0


@pytest.mark.parametrize("loss", ["pose", "autoencoder"])
def test_views_are_uniform_over_all_azimuths_and_the_band(loss):
    azimuth, elevation = views_deg(loss, 8, is_clean=False, count=400)
    counts, _ = np.histogram(azimuth, bins=8, range=(-180.0, 180.0))
    assert counts.min() > 0.75 * counts.mean() and counts.max() < 1.25 * counts.mean()
    counts, _ = np.histogram(elevation, bins=4, range=BAND_DEG)
    assert counts.min() > 0.75 * counts.mean() and counts.max() < 1.25 * counts.mean()


@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
def test_the_views_of_a_group_share_their_disturbance(share):
    config = dataclasses.replace(Config.preset("smoke").encoder, batch_size=402, shaded_share=share)
    disturbances = np.asarray(random_disturbances(jax.random.key(0), config))
    assert disturbances.shape == (402,)
    groups = disturbances[:400].reshape(100, 4)
    assert (groups == groups[:, :1]).all()
    assert set(np.unique(groups)) <= {SHADED, AUGMENTED}
    assert abs(np.mean(groups == SHADED) - share) < 0.12


def test_a_clean_example_is_what_a_search_sees_and_a_shaded_one_is_darker_only():
    config = Config.preset("smoke")
    env = vs.ViewSearchEnv(config)
    view = View(jnp.float32(2.0), jnp.mean(env.reach.band))
    examples = jax.jit(jax.vmap(lambda key, disturbance: encoder_example(key, view, disturbance, env=env).inputs))
    keys = jax.random.split(jax.random.key(0), 8)
    clean, shaded, augmented = (np.asarray(examples(keys, jnp.full(8, d))) for d in (CLEAN, SHADED, AUGMENTED))

    for i, key in enumerate(keys):
        pose_key = jax.random.split(key, 5)[0]
        qpos = env.resolve_view(view, env.random_joints(pose_key), jnp.bool_(False))[1]
        seen = encoders.network_input(env.wrist_image(qpos)[1], env.scene.object_geom_ids, config)
        np.testing.assert_allclose(clean[i], seen, atol=1e-4)
    assert (shaded <= clean + 1e-4).all()
    is_darker = (shaded < clean - 0.02).any(axis=(1, 2, 3))
    assert is_darker.mean() > 0.5  # strips may fall beside table and object
    assert (augmented > clean + 0.02).any(axis=(1, 2, 3)).all()
