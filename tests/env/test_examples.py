"""The views of the encoder's training examples."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vsearch_jax.config import Config
from vsearch_jax.env import random_example_views

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
    low, high = (1.6, 2.4) if is_clean else (4.5, 8.5)  # augmented: the root mean square of 3 to 10 degrees is 6.4
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
