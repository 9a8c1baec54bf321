"""Steps of the task between views whose images are known, so that they need no new image."""

from __future__ import annotations

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from vsearch_jax.config import EnvConfig
from vsearch_jax.env import step_reward
from vsearch_jax.geometry import angle_difference, cosine_similarity, fold_into_band, view_from_uniform, wrap_angle
from vsearch_jax.types import Observation, Transition, View

_OWN_SHARE, _NEAR_SHARE = 1 / 3, 1 / 3
"""Shares of the targets that are the end of the step, and that are near it. The others are random views of the pool."""
_NEAR_DEG = 5.0
"""Standard deviation of near targets about the end of the step, in azimuth and elevation."""


_CELL_AZIMUTHS, _CELL_ELEVATIONS = 256, 32
"""Number of cells of the pool's index. A cell is 1.4 degrees of azimuth wide."""


class IndexedPool(NamedTuple):
    """A pool of P views, and an index by which the view nearest to any view of the band is found at once.

    Attributes:
      observations: Observation of f32[P, ...] from P reachable views.
      band: f32[2] rad, lowest and highest elevation of the pool.
      nearest: i32[A, E], the pool's view nearest to the middle of each cell of azimuth and elevation.
    """

    observations: Observation
    band: Array
    nearest: Array


def index_pool(pool: Observation, band: Array) -> IndexedPool:
    """Builds the index of a pool.

    Args:
      pool: Observation of f32[P, ...] from P reachable views.
      band: f32[2] rad, lowest and highest elevation of the pool.
    """
    middles = ((jnp.arange(count, dtype=jnp.float32) + 0.5) / count for count in (_CELL_AZIMUTHS, _CELL_ELEVATIONS))
    cells = view_from_uniform(jnp.stack(jnp.meshgrid(*middles, indexing="ij")), band)

    def nearest(cell: View) -> Array:
        azimuth = angle_difference(pool.view.azimuth, cell.azimuth) * jnp.cos(cell.elevation)
        return jnp.argmin(azimuth**2 + (pool.view.elevation - cell.elevation) ** 2).astype(jnp.int32)

    return IndexedPool(pool, band, jax.lax.map(jax.vmap(nearest), cells))


def sample_pool_steps(key: Array, indexed: IndexedPool, num_steps: int, config: EnvConfig) -> Transition:
    """Draws random steps of the task between two views of the pool.

    A step starts at a random view of the pool. Its action is uniform, with the elevation folded into the band. It ends
    at a view of the pool near the commanded one, and its action is corrected for that. One third of the targets are
    the end itself, one third are near it, and one third are random. Near targets teach the policy what misses the
    threshold by little. All these steps are reachable. The arm's joints before and after the step are unrelated.

    Args:
      key: PRNG key.
      indexed: the pool, from `index_pool`.
      num_steps: number of steps N.
      config: size of an action, threshold and rewards.

    Returns:
      The steps: a Transition with leading axis N.
    """
    start_key, action_key, target_key = jax.random.split(key, 3)
    pool = indexed.observations
    count, scale = pool.code.shape[0], math.radians(config.action_scale_deg)
    start = jax.random.randint(start_key, (num_steps,), 0, count)
    change = scale * jax.random.uniform(action_key, (2, num_steps), minval=-1.0, maxval=1.0)
    end = _neighbours(indexed, start, change)
    moved = [
        angle_difference(pool.view.azimuth[end], pool.view.azimuth[start]),
        pool.view.elevation[end] - pool.view.elevation[start],
    ]
    target = pool.code[_targets(target_key, indexed, end)]
    is_reachable = jnp.ones(num_steps, bool)
    reward, is_found = step_reward(cosine_similarity(pool.code[end], target), is_reachable, config)
    obs, next_obs = (jnp.concatenate([pool.code[i], target, pool.qpos[i]], axis=-1) for i in (start, end))
    return Transition(
        obs=obs,
        action=jnp.clip(jnp.stack(moved, axis=-1) / scale, -1.0, 1.0),
        reward=reward,
        next_obs=next_obs,
        terminated=is_found.astype(jnp.float32),
        is_reachable=is_reachable.astype(jnp.float32),
    )


def _targets(key: Array, indexed: IndexedPool, end: Array) -> Array:
    """Returns the indices i32[N] of the targets of steps that end at the views with the indices `end`."""
    choice_key, near_key, random_key = jax.random.split(key, 3)
    shape, count = end.shape, indexed.observations.code.shape[0]
    choice = jax.random.uniform(choice_key, shape)
    near = _neighbours(indexed, end, math.radians(_NEAR_DEG) * jax.random.normal(near_key, (2, *shape)))
    target = jnp.where(choice < _OWN_SHARE + _NEAR_SHARE, near, jax.random.randint(random_key, shape, 0, count))
    return jnp.where(choice < _OWN_SHARE, end, target)


def _neighbours(indexed: IndexedPool, start: Array, change: Array) -> Array:
    """Returns which views of the pool are near other views of it, moved by a change.

    Args:
      indexed: the pool.
      start: i32[N], indices of the views to start from.
      change: f32[2, N] rad, changes of azimuth and elevation. The elevation is folded into the band.

    Returns:
      Indices i32[N].
    """
    views, (low, high) = indexed.observations.view, indexed.band
    azimuth = wrap_angle(views.azimuth[start] + change[0])
    elevation = fold_into_band(views.elevation[start] + change[1], indexed.band)
    cell = jnp.stack([azimuth / (2.0 * jnp.pi) + 0.5, (elevation - low) / jnp.maximum(high - low, 1e-6)])
    counts = jnp.asarray(indexed.nearest.shape, jnp.float32)[:, None]
    cell = jnp.clip(jnp.floor(cell * counts), 0.0, counts - 1.0).astype(jnp.int32)
    return indexed.nearest[cell[0], cell[1]]
