"""Shortens a path by straight edges between random points on it (Geraerts and Overmars, 2007)."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from vsearch_jax.config import PlanningConfig
from vsearch_jax.planning.edges import Edge, check_edge, edge_between, is_decided, is_proven_free
from vsearch_jax.robot.arm import Arm
from vsearch_jax.xla.tree import tree_where

SAMPLES_PER_STEP = 2
# A shortcut must save this share of the path's length. A smaller saving is not worth its samples.
MIN_SAVING = 0.002
# Random shortcuts of which the best is tried. More candidates give longer shortcuts, which are blocked more often.
NUM_CANDIDATES = 4


class PathToShorten(NamedTuple):
    """A path to shorten. W waypoints, J joints that move the camera.

    Attributes:
      waypoints: f32[W, J] rad or m; the last waypoint fills the remaining rows.
      num_points: i32[], number of waypoints without the repetitions.
      qpos: f32[nq] rad or m. It supplies the values of the joints that do not move the camera.
      key: PRNG key.
    """

    waypoints: Array
    num_points: Array
    qpos: Array
    key: Array


class ShortcutState(NamedTuple):
    """State of a lane, which shortens one path at a time. W waypoints, J joints that move the camera.

    Attributes:
      waypoints: f32[W, J] rad or m, the path so far; the last waypoint fills the remaining rows.
      num_points: i32[], number of waypoints without the repetitions.
      edge: Edge (straight joint path) that may replace the part of the path between its ends.
      first: i32[], number of the waypoint before the edge's start.
      last: i32[], number of the waypoint after the edge's end.
      attempts: i32[], number of edges tried.
    """

    waypoints: Array
    num_points: Array
    edge: Edge
    first: Array
    last: Array
    attempts: Array


def empty_lane(arm: Arm, config: PlanningConfig) -> ShortcutState:
    """Returns the state of a lane (a slot that shortens one path at a time) that holds no path yet.

    Args:
      arm: the arm.
      config: `max_waypoints` is the number of waypoints that the lane can hold.
    """
    origin, zero = jnp.zeros(arm.chain.address.shape[0]), jnp.int32(0)
    waypoints = jnp.zeros((config.max_waypoints, origin.shape[0]))
    return ShortcutState(waypoints, zero, edge_between(arm, origin, origin), zero, zero, zero)


def reset_lane(arm: Arm, problem: PathToShorten, state: ShortcutState, is_new: Array) -> ShortcutState:
    """Gives a lane (a slot that shortens one path at a time) a new path and proposes the first shortcut.

    Args:
      arm: the arm.
      problem: the new path.
      state: present state of the lane.
      is_new: bool[], whether the lane takes the new path.

    Returns:
      The state with the new path where `is_new`, else `state`.
    """
    start = state._replace(waypoints=problem.waypoints, num_points=problem.num_points, attempts=jnp.int32(0))
    return tree_where(is_new, _propose_shortcut(arm, problem, start), state)


def is_lane_done(config: PlanningConfig, state: ShortcutState) -> Array:
    """Returns bool[]: the lane cannot shorten its path any more. All attempts are used, or the path is a straight line.

    Args:
      config: `num_shortcuts` is the number of attempts.
      state: state of the lane.
    """
    return (state.attempts >= config.num_shortcuts) | (state.num_points <= 2)


def step_lane(arm: Arm, config: PlanningConfig, problem: PathToShorten, state: ShortcutState) -> ShortcutState:
    """Continues the contact check of the lane's proposed shortcut by a few samples.

    A lane is a slot that shortens one path at a time. If the check is complete, a shortcut that is free of
    contact replaces a part of the path. Then the next shortcut is proposed.

    Args:
      arm: the arm.
      config: resolution and number of attempts.
      problem: the path that the lane shortens.
      state: state of the lane.

    Returns:
      The next state; unchanged if the lane is done.
    """
    edge = check_edge(arm, state.edge, problem.qpos, config, SAMPLES_PER_STEP)
    is_free = is_proven_free(edge)
    shortened = _insert_edge(state._replace(edge=edge))
    waypoints, num_points = tree_where(is_free, shortened, (state.waypoints, state.num_points))
    following = _propose_shortcut(
        arm, problem, state._replace(waypoints=waypoints, num_points=num_points, attempts=state.attempts + 1)
    )
    undecided = state._replace(edge=edge)
    new = tree_where(is_decided(edge), following, undecided)
    return tree_where(is_lane_done(config, state), state, new)


def _propose_shortcut(arm: Arm, problem: PathToShorten, state: ShortcutState) -> ShortcutState:
    """Sets the edge to the random shortcut with the largest saving. If that is too small, the edge is blocked."""
    lengths = jnp.linalg.norm(jnp.diff(state.waypoints, axis=0), axis=-1)
    ends = jnp.cumsum(lengths)
    place_key, corner_key = jax.random.split(jax.random.fold_in(problem.key, state.attempts))
    places = jax.random.uniform(place_key, (NUM_CANDIDATES, 2)) * ends[-1]
    # Half of the candidates start at a waypoint, so that they remove it.
    corners = ends[jax.random.randint(corner_key, (NUM_CANDIDATES // 2,), 0, jnp.maximum(state.num_points - 2, 1))]
    places = jnp.sort(places.at[: NUM_CANDIDATES // 2, 0].set(corners), axis=1)
    segment = jnp.minimum(jnp.searchsorted(ends, places), state.num_points - 2).astype(jnp.int32)
    length = jnp.maximum(lengths[segment], 1e-9)
    share = jnp.clip((places - (ends[segment] - lengths[segment])) / length, 0.0, 1.0)
    below, above = state.waypoints[segment], state.waypoints[segment + 1]
    points = below + share[..., None] * (above - below)
    saving: Array = places[:, 1] - places[:, 0] - jnp.linalg.norm(points[:, 1] - points[:, 0], axis=-1)
    num_removed = segment[:, 1] - segment[:, 0]
    fits = (num_removed > 0) & (state.num_points + 2 - num_removed <= state.waypoints.shape[0])
    best = jnp.argmax(jnp.where(fits, saving, -jnp.inf))
    is_worth_trying = fits[best] & (saving[best] > MIN_SAVING * ends[-1])
    edge = edge_between(arm, points[best, 0], points[best, 1])
    return state._replace(
        edge=edge._replace(is_blocked=~is_worth_trying), first=segment[best, 0], last=segment[best, 1] + 1
    )


def _insert_edge(state: ShortcutState) -> tuple[Array, Array]:
    """Returns waypoints f32[W, J] and their number i32[] with the edge between waypoints `first` and `last`."""
    count = state.num_points + 3 - (state.last - state.first)
    place = jnp.minimum(jnp.arange(state.waypoints.shape[0]), count - 1)
    source = jnp.where(place <= state.first, place, place - state.first - 3 + state.last)
    path = state.waypoints[jnp.clip(source, 0, state.waypoints.shape[0] - 1)]
    end = state.edge.start + state.edge.change
    path = jnp.where((place == state.first + 1)[:, None], state.edge.start[None], path)
    return jnp.where((place == state.first + 2)[:, None], end[None], path), count
