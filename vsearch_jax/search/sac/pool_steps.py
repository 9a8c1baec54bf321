"""Steps of the task between views whose images are known, so that they need no new image."""

from __future__ import annotations

import functools
import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from vsearch_jax.config import EnvConfig
from vsearch_jax.env import step_reward
from vsearch_jax.geometry import angle_difference, cosine_similarity, fold_into_band, view_from_uniform, wrap_angle
from vsearch_jax.search.sac.agent import KnownActions
from vsearch_jax.types import Observation, ReachabilityMap, Transition, View

_OWN_SHARE, _NEAR_SHARE = 1 / 3, 1 / 3
"""Shares of the targets that are the end of the step, and that are near it. The others are random views of the pool."""
_NEAR_DEG = 5.0
"""Standard deviation of near targets about the end of the step, in azimuth and elevation."""
_EDGE_MARGIN_DEG = 1.0
"""Known actions end this far inside the band. A policy whose error is smaller still commands a reachable view."""
_BEYOND_SHARE = 1 / 3
"""Share of the steps whose elevation is not folded into the band."""
_CELL_AZIMUTHS, _CELL_ELEVATIONS = 256, 32
"""Number of cells of the pool's index. A cell is 1.4 degrees of azimuth wide."""


class IndexedPool(NamedTuple):
    """A pool of P views, and an index by which a view of the pool near any view of the band is found at once.

    Attributes:
      observations: Observation of f32[P, ...] from P reachable views.
      reach: the views that the arm reaches.
      nearest: i32[A, E], the pool's view nearest to the middle of each cell of azimuth and elevation of the band.
    """

    observations: Observation
    reach: ReachabilityMap
    nearest: Array


def index_pool(pool: Observation, reach: ReachabilityMap) -> IndexedPool:
    """Builds the index of a pool.

    Args:
      pool: Observation of f32[P, ...] from P views of the reachable band.
      reach: the views that the arm reaches.
    """
    middles = ((jnp.arange(count, dtype=jnp.float32) + 0.5) / count for count in (_CELL_AZIMUTHS, _CELL_ELEVATIONS))
    cells = view_from_uniform(jnp.stack(jnp.meshgrid(*middles, indexing="ij")), reach.band)

    def nearest(cell: View) -> Array:
        azimuth = angle_difference(pool.view.azimuth, cell.azimuth) * jnp.cos(cell.elevation)
        return jnp.argmin(azimuth**2 + (pool.view.elevation - cell.elevation) ** 2).astype(jnp.int32)

    return IndexedPool(pool, reach, jax.lax.map(jax.vmap(nearest), cells))


def sample_pool_steps(
    key: Array, indexed: IndexedPool, num_steps: int, config: EnvConfig
) -> tuple[Transition, KnownActions]:
    """Draws random steps of the task between two views of the pool.

    A step starts at a random view of the pool. Its action is uniform, with the elevation folded into the band. It ends
    at a view of the pool near the commanded one, and its action is corrected for that. In one third of the steps the
    elevation is not folded. If the arm then cannot reach the commanded view by the reachability map, it stays.

    One third of the targets are the end itself, one third are near it, and one third are random. Near targets teach the
    policy what misses the threshold by little. The arm's joints before and after the step are unrelated.

    The views are known, so the action that leads from the start straight to the target is known too if one step is
    enough. It stops 1 degree before the edge of the band: a view beyond the edge is unreachable, and the policy would
    command it again and again.

    Args:
      key: PRNG key.
      indexed: the pool, from `index_pool`.
      num_steps: number of steps N.
      config: size of an action, threshold and rewards.

    Returns:
      The steps: a Transition with leading axis N. And the actions that lead to the targets, from the same starts.
    """
    start_key, action_key, beyond_key, target_key = jax.random.split(key, 4)
    pool, scale = indexed.observations, math.radians(config.action_scale_deg)
    start = jax.random.randint(start_key, (num_steps,), 0, pool.code.shape[0])
    wanted = jax.random.uniform(action_key, (2, num_steps), minval=-1.0, maxval=1.0)
    commanded = View(pool.view.azimuth[start] + scale * wanted[0], pool.view.elevation[start] + scale * wanted[1])
    is_beyond = jax.random.uniform(beyond_key, (num_steps,)) < _BEYOND_SHARE
    is_reachable = ~is_beyond | _may_be_reachable(indexed.reach, commanded)
    end = jnp.where(is_reachable, _neighbours(indexed, commanded), start)
    action = jnp.where(is_reachable, jnp.clip(_change(pool.view, start, end) / scale, -1.0, 1.0), wanted)
    targets = _targets(target_key, indexed, end)
    target, straight = pool.code[targets], _straight_change(indexed, start, targets) / scale
    is_known = jnp.max(jnp.abs(straight), axis=0) <= 1.0
    reward, is_found = step_reward(cosine_similarity(pool.code[end], target), is_reachable, config)
    obs, next_obs = (jnp.concatenate([pool.code[i], target, pool.qpos[i]], axis=-1) for i in (start, end))
    steps = Transition(
        obs=obs,
        action=action.T,
        reward=reward,
        next_obs=next_obs,
        terminated=is_found.astype(jnp.float32),
        is_reachable=is_reachable.astype(jnp.float32),
    )
    return steps, KnownActions(obs=obs, action=straight.T, is_known=is_known.astype(jnp.float32))


def _change(views: View, start: Array, end: Array) -> Array:
    """Returns f32[2, N] rad, the changes of azimuth and elevation between views with the indices `start` and `end`."""
    azimuth = angle_difference(views.azimuth[end], views.azimuth[start])
    return jnp.stack([azimuth, views.elevation[end] - views.elevation[start]])


def _straight_change(indexed: IndexedPool, start: Array, target: Array) -> Array:
    """Returns f32[2, N] rad, the changes of azimuth and elevation that lead to the targets, inside the band's edges."""
    views, (low, high) = indexed.observations.view, indexed.reach.band
    margin = jnp.minimum(math.radians(_EDGE_MARGIN_DEG), 0.5 * (high - low))
    elevation = jnp.clip(views.elevation[target], low + margin, high - margin)
    return jnp.stack([_change(views, start, target)[0], elevation - views.elevation[start]])


def _may_be_reachable(reach: ReachabilityMap, view: View) -> Array:
    """Returns bool[N], whether any of the four views of the map around a view is reachable; `view` is of f32[N] rad."""
    num_azimuths, num_elevations = reach.is_reachable.shape
    row = jnp.floor(wrap_angle(view.azimuth) / (2.0 * jnp.pi) * num_azimuths).astype(jnp.int32)
    spacing = (reach.elevations[-1] - reach.elevations[0]) / (num_elevations - 1)
    column = jnp.floor((view.elevation - reach.elevations[0]) / spacing).astype(jnp.int32)
    corners = [
        reach.is_reachable[(row + i) % num_azimuths, jnp.clip(column + j, 0, num_elevations - 1)]
        for i, j in ((0, 0), (0, 1), (1, 0), (1, 1))
    ]
    is_mapped = (column >= -1) & (column < num_elevations)
    return is_mapped & functools.reduce(jnp.logical_or, corners)


def _targets(key: Array, indexed: IndexedPool, end: Array) -> Array:
    """Returns the indices i32[N] of the targets of steps that end at the views with the indices `end`."""
    choice_key, near_key, random_key = jax.random.split(key, 3)
    shape, count = end.shape, indexed.observations.code.shape[0]
    choice = jax.random.uniform(choice_key, shape)
    offset = math.radians(_NEAR_DEG) * jax.random.normal(near_key, (2, *shape))
    views = indexed.observations.view
    near = _neighbours(indexed, View(views.azimuth[end] + offset[0], views.elevation[end] + offset[1]))
    target = jnp.where(choice < _OWN_SHARE + _NEAR_SHARE, near, jax.random.randint(random_key, shape, 0, count))
    return jnp.where(choice < _OWN_SHARE, end, target)


def _neighbours(indexed: IndexedPool, view: View) -> Array:
    """Returns indices i32[N] of views of the pool that are near N views, f32[N] rad, folded into the band."""
    low, high = indexed.reach.band
    elevation = fold_into_band(view.elevation, indexed.reach.band)
    part = [wrap_angle(view.azimuth) / (2.0 * jnp.pi) + 0.5, (elevation - low) / jnp.maximum(high - low, 1e-6)]
    counts = jnp.asarray(indexed.nearest.shape, jnp.float32)[:, None]
    cell = jnp.clip(jnp.floor(jnp.stack(part) * counts), 0.0, counts - 1.0).astype(jnp.int32)
    return indexed.nearest[cell[0], cell[1]]
