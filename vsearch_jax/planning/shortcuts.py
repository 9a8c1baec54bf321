"""Shortens a path by straight ways between random points of it (Geraerts and Overmars, 2007)."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from vsearch_jax.config import PlanningConfig
from vsearch_jax.planning.edges import Edge, advance, edge_between, is_settled, is_whole
from vsearch_jax.robot.arm import Arm
from vsearch_jax.xla.tree import tree_where

SAMPLES_PER_STEP = 2
# A shortcut must save this share of the path, else it is not worth its samples.
LEAST_SAVING = 0.002
# More would choose bolder shortcuts, of which more are blocked.
NUM_CANDIDATES = 4


class Crooked(NamedTuple):
    """A path that is to be shortened: f32[W, J] its end repeated, i32[] its configurations, f32[nq] joints, its key."""

    waypoints: Array
    num_points: Array
    qpos: Array
    key: Array


class Shortcut(NamedTuple):
    """A lane.

    Attributes:
      waypoints: f32[W, J] rad or m, the path so far, its end repeated.
      num_points: i32[], its configurations.
      edge: Edge that may replace what lies between its ends.
      first: i32[], the waypoint before the edge's start.
      last: i32[], the waypoint after the edge's end.
      attempts: i32[], edges tried.
    """

    waypoints: Array
    num_points: Array
    edge: Edge
    first: Array
    last: Array
    attempts: Array


def empty(arm: Arm, config: PlanningConfig) -> Shortcut:
    """Returns a lane that `begin` can use."""
    origin, zero = jnp.zeros(arm.chain.address.shape[0]), jnp.int32(0)
    waypoints = jnp.zeros((config.max_waypoints, origin.shape[0]))
    return Shortcut(waypoints, zero, edge_between(arm, origin, origin), zero, zero, zero)


def begin(arm: Arm, problem: Crooked, state: Shortcut, is_new: Array) -> Shortcut:
    """Starts on the path of `problem` where `is_new`."""
    fresh = _propose(
        arm,
        problem,
        state._replace(waypoints=problem.waypoints, num_points=problem.num_points, attempts=jnp.int32(0)),
    )
    return tree_where(is_new, fresh, state)


def is_done(config: PlanningConfig, state: Shortcut) -> Array:
    """Returns bool[]: all attempts are spent, or the path is straight."""
    return (state.attempts >= config.num_shortcuts) | (state.num_points <= 2)


def step(arm: Arm, config: PlanningConfig, problem: Crooked, state: Shortcut) -> Shortcut:
    """Looks at some samples of the edge; where it is settled, takes it if it is free, and proposes the next."""
    edge = advance(arm, state.edge, problem.qpos, config, SAMPLES_PER_STEP)
    is_free = is_whole(edge)
    taken = _cut(state._replace(edge=edge))
    path = tree_where(is_free, taken, (state.waypoints, state.num_points))
    following = _propose(
        arm, problem, state._replace(waypoints=path[0], num_points=path[1], attempts=state.attempts + 1)
    )
    waiting = state._replace(edge=edge)
    new = tree_where(is_settled(edge), following, waiting)
    return tree_where(is_done(config, state), state, new)


def _propose(arm: Arm, problem: Crooked, state: Shortcut) -> Shortcut:
    """Takes the shortcut that saves most of some random ones; one that is not worth trying counts as blocked."""
    lengths = jnp.linalg.norm(jnp.diff(state.waypoints, axis=0), axis=-1)
    ends = jnp.cumsum(lengths)
    place_key, corner_key = jax.random.split(jax.random.fold_in(problem.key, state.attempts))
    places = jax.random.uniform(place_key, (NUM_CANDIDATES, 2)) * ends[-1]
    # Half of them start at a waypoint: those are what a path has too many of.
    corners = ends[jax.random.randint(corner_key, (NUM_CANDIDATES // 2,), 0, jnp.maximum(state.num_points - 2, 1))]
    places = jnp.sort(places.at[: NUM_CANDIDATES // 2, 0].set(corners), axis=1)
    segment = jnp.minimum(jnp.searchsorted(ends, places), state.num_points - 2).astype(jnp.int32)
    length = jnp.maximum(lengths[segment], 1e-9)
    share = jnp.clip((places - (ends[segment] - lengths[segment])) / length, 0.0, 1.0)
    below, above = state.waypoints[segment], state.waypoints[segment + 1]
    points = below + share[..., None] * (above - below)
    saving = places[:, 1] - places[:, 0] - jnp.linalg.norm(points[:, 1] - points[:, 0], axis=-1)
    num_cut = segment[:, 1] - segment[:, 0]
    fits = (num_cut > 0) & (state.num_points + 2 - num_cut <= state.waypoints.shape[0])
    best = jnp.argmax(jnp.where(fits, saving, -jnp.inf))  # pyright: ignore[reportArgumentType] # an array, of three arguments
    is_worth = fits[best] & (saving[best] > LEAST_SAVING * ends[-1])
    edge = edge_between(arm, points[best, 0], points[best, 1])
    return state._replace(edge=edge._replace(is_blocked=~is_worth), first=segment[best, 0], last=segment[best, 1] + 1)


def _cut(state: Shortcut) -> tuple[Array, Array]:
    """Returns the path, and its configurations, with the edge between its waypoints `first` and `last`."""
    count = state.num_points + 3 - (state.last - state.first)
    place = jnp.minimum(jnp.arange(state.waypoints.shape[0]), count - 1)
    source = jnp.where(place <= state.first, place, place - state.first - 3 + state.last)
    path = state.waypoints[jnp.clip(source, 0, state.waypoints.shape[0] - 1)]
    end = state.edge.start + state.edge.change
    path = jnp.where((place == state.first + 1)[:, None], state.edge.start[None], path)
    return jnp.where((place == state.first + 2)[:, None], end[None], path), count
