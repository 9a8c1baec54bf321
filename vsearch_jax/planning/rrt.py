"""Collision-free joint paths by random trees: uniform RRT and RRT-Connect, many problems at once."""

from __future__ import annotations

import functools
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from vsearch_jax.config import PlanningConfig
from vsearch_jax.planning import shortcuts, trees
from vsearch_jax.planning.edges import Edge, advance, edge_between, is_settled, is_whole
from vsearch_jax.planning.shortcuts import Crooked
from vsearch_jax.planning.trees import Problem
from vsearch_jax.robot.arm import Arm, forward_kinematics, is_free
from vsearch_jax.types import Path, PlanStatus
from vsearch_jax.xla import lane_pool
from vsearch_jax.xla.batching import flatten_vmap
from vsearch_jax.xla.tree import tree_where

# Lanes of a batch: more cost less each, but more of them idle at the end.
MOST_LANES = 64


def rrt_connect(arm: Arm, key: Array, start: Array, goal: Array, config: PlanningConfig) -> Path:
    """Returns a joint path from `start` to `goal` on which nothing touches and the table's clearance is kept.

    The straight joint path comes first; two trees that grow towards one another where it is blocked; shortcuts shorten
    what they find. That the path is free is proven (see `edges`), under the model's own geometry.

    Under `vmap` the problems share a fixed number of lanes (see `xla.lane_pool`), so that none waits for the slowest;
    the arm cannot be mapped over.

    Args:
      arm: the arm.
      key: PRNG key of the samples.
      start: f32[nq] rad or m. Joints that do not move the camera keep these values.
      goal: f32[nq] rad or m.
      config: sizes, steps and resolution.

    Returns:
      The path. Its status is START_BLOCKED or GOAL_BLOCKED where that configuration is not finite, outside the limits
      or not free, and EXHAUSTED where nodes or iterations ran out, which is no proof that there is no path.
    """
    return _plan(True, arm, key, start, goal, config)


def rrt(arm: Arm, key: Array, start: Array, goal: Array, config: PlanningConfig) -> Path:
    """The same by one uniform tree, each new node of which tries the straight way to the goal (LaValle 1998)."""
    return _plan(False, arm, key, start, goal, config)


def _plan(is_bidirectional: bool, arm: Arm, key: Array, start: Array, goal: Array, config: PlanningConfig) -> Path:
    plan = flatten_vmap(functools.partial(_plan_batch, is_bidirectional, config))
    result = plan(arm, (key[None], start[None], goal[None]))
    return jax.tree.map(lambda leaf: leaf[0], result)


def _plan_batch(is_bidirectional: bool, config: PlanningConfig, arm: Arm, batch: tuple[Array, Array, Array]) -> Path:
    keys, starts, goals = batch
    address = arm.chain.address
    finite = jnp.where(jnp.isfinite(starts), starts, arm.home[None])
    problems = Problem(finite[:, address], goals[:, address], finite, keys)
    goals = finite.at[:, address].set(problems.goal)
    ends = jnp.concatenate([starts, goals])
    is_start_good, is_goal_good = jnp.split(jax.vmap(functools.partial(_is_good, arm))(ends), 2)
    is_sound = is_start_good & is_goal_good

    is_straight = _straight(arm, config, problems, is_sound)
    is_open = is_sound & ~is_straight
    straight = jnp.concatenate(
        [problems.start[:, None], jnp.repeat(problems.goal[:, None], config.max_waypoints - 1, axis=1)], axis=1
    )
    blank = (straight, jnp.full(keys.shape[0], 2, jnp.int32), is_straight)
    waypoints, counts, is_found = _grow(arm, config, is_bidirectional, problems, is_open, blank)
    crooked = Crooked(waypoints, counts, problems.qpos, problems.key)
    waypoints = _shorten(arm, config, crooked, is_open & is_found)
    status = jnp.where(is_found, int(PlanStatus.FOUND), int(PlanStatus.EXHAUSTED))
    status = jnp.where(is_goal_good, status, int(PlanStatus.GOAL_BLOCKED))
    status = jnp.where(is_start_good, status, int(PlanStatus.START_BLOCKED))
    length = jnp.sum(jnp.linalg.norm(jnp.diff(waypoints, axis=1), axis=-1), axis=-1)
    waypoints = jnp.where(is_found[:, None, None], waypoints, problems.start[:, None])
    whole = jnp.repeat(finite[:, None], config.max_waypoints, axis=1)
    return Path(
        waypoints=whole.at[:, :, address].set(waypoints),
        length=jnp.where(is_found, length, jnp.inf),
        status=status.astype(jnp.int32),
    )


def _is_good(arm: Arm, qpos: Array) -> Array:
    is_within = jnp.all((qpos >= arm.lower) & (qpos <= arm.upper))  # false for NaN
    return is_within & is_free(arm, forward_kinematics(arm, qpos))


def _straight(arm: Arm, config: PlanningConfig, problems: Problem, is_open: Array) -> Array:
    """Returns bool[N]: of the problems where `is_open`, those that need no tree."""

    def begin(problem: Problem, edge: Edge, is_new: Array) -> Edge:
        fresh = edge_between(arm, problem.start, problem.goal)
        return tree_where(is_new, fresh, edge)

    job = lane_pool.Job(
        begin,
        lambda problem, edge: advance(arm, edge, problem.qpos, config),
        is_settled,
        lambda _, edge: is_whole(edge),
        has_stragglers=False,
    )
    origin = jnp.zeros(problems.start.shape[1])
    states = _copies(edge_between(arm, origin, origin), is_open)
    return lane_pool.run(job, problems, lane_pool.queue_where(is_open), states, jnp.zeros(is_open.shape[0], bool))


def _grow(
    arm: Arm, config: PlanningConfig, is_bidirectional: bool, problems: Problem, is_open: Array, blank: Any
) -> tuple[Array, Array, Array]:
    """Returns waypoints f32[N, W, J], counts i32[N] and bool[N] whether found; as in `blank` where not `is_open`."""

    def finish(_: Problem, state: trees.Trees) -> tuple[Array, Array, Array]:
        waypoints, count = trees.waypoints(config, state)
        return waypoints, count, state.is_found & (count <= config.max_waypoints)

    job = lane_pool.Job(
        functools.partial(trees.begin, arm, config),
        functools.partial(trees.step, arm, config, is_bidirectional),
        lambda state: state.is_done,
        finish,
    )
    return lane_pool.run(
        job, problems, lane_pool.queue_where(is_open), _copies(trees.empty(arm, config), is_open), blank
    )


def _shorten(arm: Arm, config: PlanningConfig, paths: Crooked, is_open: Array) -> Array:
    job = lane_pool.Job(
        functools.partial(shortcuts.begin, arm),
        functools.partial(shortcuts.step, arm, config),
        functools.partial(shortcuts.is_done, config),
        lambda _, state: state.waypoints,
        has_stragglers=False,
    )
    states = _copies(shortcuts.empty(arm, config), is_open)
    return lane_pool.run(job, paths, lane_pool.queue_where(is_open), states, paths.waypoints)


def _copies(state: Any, problems: Array) -> Any:
    num_lanes = min(MOST_LANES, problems.shape[0])
    return jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (num_lanes, *leaf.shape)), state)
