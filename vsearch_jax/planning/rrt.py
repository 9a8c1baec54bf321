"""Collision-free joint paths by random trees, many problems at once: RRT and RRT-Connect."""

from __future__ import annotations

import functools
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jax import Array

from vsearch_jax.config import PlanningConfig
from vsearch_jax.planning import lane_counts, shortcuts, trees
from vsearch_jax.planning.edges import Edge, check_edge, edge_between, is_decided, is_proven_free
from vsearch_jax.planning.shortcuts import PathToShorten
from vsearch_jax.planning.trees import PlanningProblem
from vsearch_jax.robot.arm import Arm, forward_kinematics, is_free
from vsearch_jax.types import Path, PlanStatus
from vsearch_jax.xla import lane_pool
from vsearch_jax.xla.batching import flatten_vmap
from vsearch_jax.xla.tree import tree_where

State = TypeVar("State")
# Goals that are tried if there is no path to the given one. In each of them one hinge is turned by a full turn.
NUM_EQUIVALENTS = 2


class _Paths(NamedTuple):
    """Paths before shortening, leading axis N; W waypoints, J joints of the chain.

    Attributes:
      waypoints: f32[N, W, J] rad or m, the last one repeated.
      num_points: i32[N], number of waypoints without the repetitions.
      is_found: bool[N].
    """

    waypoints: Array
    num_points: Array
    is_found: Array


def rrt_connect(arm: Arm, key: Array, start: Array, goal: Array, config: PlanningConfig) -> Path:
    """Plans a joint path on which nothing touches and the table's clearance is kept.

    The straight joint path is tried first. If it is blocked, two trees grow from start and goal until they meet
    (Kuffner and LaValle 2000), and shortcuts shorten the path through them. The path is proven free of contact for the
    model's geometry (see `planning.edges`). If no path is found, the same is tried for the two nearest goals in which
    one hinge is turned by a full turn inside its limits. The path then ends at that goal.

    Under `vmap` the problems share a fixed number of lanes: each lane solves one problem after another, so no problem
    waits for the slowest (see `xla.lane_pool` and `planning.lane_counts`). `vmap` over the arm raises
    NotImplementedError.

    Args:
      arm: the arm.
      key: PRNG key of the random configurations.
      start: f32[nq] rad or m, joint values at the start. Joints that do not move the camera keep these values.
      goal: f32[nq] rad or m, joint values at the goal.
      config: numbers of nodes, edges and waypoints; length of edges; resolution of the contact check.

    Returns:
      The path. Its status is START_BLOCKED or GOAL_BLOCKED if that configuration is not finite, outside the limits, in
      contact or too near the table. It is EXHAUSTED if nodes or iterations ran out; this does not prove that no path
      exists.
    """
    return _plan(True, arm, key, start, goal, config)


def rrt(arm: Arm, key: Array, start: Array, goal: Array, config: PlanningConfig) -> Path:
    """Plans a joint path like `rrt_connect`, but with one tree that grows from the start (RRT, LaValle 1998).

    Each new node of the tree tries to connect to the goal by a straight joint path.

    Args:
      arm: the arm.
      key: PRNG key of the random configurations.
      start: f32[nq] rad or m, joint values at the start. Joints that do not move the camera keep these values.
      goal: f32[nq] rad or m, joint values at the goal.
      config: numbers of nodes, edges and waypoints; length of edges; resolution of the contact check.

    Returns:
      The path, with the statuses of `rrt_connect`.
    """
    return _plan(False, arm, key, start, goal, config)


def _plan(is_bidirectional: bool, arm: Arm, key: Array, start: Array, goal: Array, config: PlanningConfig) -> Path:
    plan = flatten_vmap(functools.partial(_plan_batch, is_bidirectional, config))
    result = plan(arm, (key[None], start[None], goal[None]))
    return jax.tree.map(lambda leaf: leaf[0], result)


def _plan_batch(is_bidirectional: bool, config: PlanningConfig, arm: Arm, batch: tuple[Array, Array, Array]) -> Path:
    """Plans N problems: keys [N], starts f32[N, nq] and goals f32[N, nq]."""
    keys, starts, goals = batch
    address = arm.chain.address
    finite = jnp.where(jnp.isfinite(starts), starts, arm.home[None])
    problems = PlanningProblem(finite[:, address], goals[:, address], finite, keys)
    goals = finite.at[:, address].set(problems.goal)
    ends = jnp.concatenate([starts, goals])
    is_start_good, is_goal_good = jnp.split(jax.vmap(functools.partial(_is_good, arm))(ends), 2)
    paths = _find_paths(arm, config, is_bidirectional, problems, is_start_good & is_goal_good)
    to_shorten = PathToShorten(paths.waypoints, paths.num_points, problems.qpos, problems.key)
    waypoints = _shorten(arm, config, to_shorten, paths.is_found & (paths.num_points > 2))
    status = jnp.where(paths.is_found, int(PlanStatus.FOUND), int(PlanStatus.EXHAUSTED))
    status = jnp.where(is_goal_good, status, int(PlanStatus.GOAL_BLOCKED))
    status = jnp.where(is_start_good, status, int(PlanStatus.START_BLOCKED))
    length = jnp.sum(jnp.linalg.norm(jnp.diff(waypoints, axis=1), axis=-1), axis=-1)
    waypoints = jnp.where(paths.is_found[:, None, None], waypoints, problems.start[:, None])
    whole = jnp.repeat(finite[:, None], config.max_waypoints, axis=1)
    return Path(
        waypoints=whole.at[:, :, address].set(waypoints),
        length=jnp.where(paths.is_found, length, jnp.inf),
        status=status.astype(jnp.int32),
    )


def _find_paths(
    arm: Arm, config: PlanningConfig, is_bidirectional: bool, problems: PlanningProblem, is_plannable: Array
) -> _Paths:
    """Returns straight paths and paths by trees to the goals, or to full-turn equivalents where there are none."""
    goals, is_inside = jax.vmap(functools.partial(_equivalent_goals, arm))(problems.start, problems.goal)
    start = jnp.repeat(problems.start[:, None], config.max_waypoints, axis=1)
    nothing = _Paths(start, jnp.full(start.shape[0], 2, jnp.int32), jnp.zeros(start.shape[0], bool))

    def is_open(index: Array, paths: _Paths) -> Array:
        return is_plannable & is_inside[:, jnp.minimum(index, NUM_EQUIVALENTS)] & ~paths.is_found

    def attempt(state: tuple[Array, _Paths]) -> tuple[Array, _Paths]:
        index, paths = state
        tried, is_tried = problems._replace(goal=goals[:, index]), is_open(index, paths)
        is_straight = _check_straight(arm, config, tried, is_tried)
        ends = jnp.repeat(tried.goal[:, None], config.max_waypoints - 1, axis=1)
        straight = paths._replace(waypoints=jnp.concatenate([start[:, :1], ends], axis=1), is_found=is_straight)
        paths = jax.tree.map(
            lambda new, old: jnp.where(is_tried.reshape(-1, *[1] * (new.ndim - 1)), new, old), straight, paths
        )
        return index + 1, _grow_trees(arm, config, is_bidirectional, tried, is_tried & ~is_straight, paths)

    # One loop holds all attempts, so its body is compiled once.
    _, paths = jax.lax.while_loop(
        lambda state: (state[0] <= NUM_EQUIVALENTS) & jnp.any(is_open(*state)), attempt, (jnp.int32(0), nothing)
    )
    return paths


def _equivalent_goals(arm: Arm, start: Array, goal: Array) -> tuple[Array, Array]:
    """Returns the goal and the nearest goals in which one hinge is turned by a full turn, f32[1 + NUM_EQUIVALENTS, J].

    Also returns bool[1 + NUM_EQUIVALENTS], whether each lies inside the limits. The first is the goal itself.
    """
    address = arm.chain.address
    turns = 2.0 * jnp.pi * jnp.where(arm.chain.is_slide, 0.0, 1.0)
    shifts = jnp.concatenate([jnp.diag(turns), -jnp.diag(turns)])
    candidates = goal[None] + shifts
    is_inside = (candidates >= arm.lower[address][None]) & (candidates <= arm.upper[address][None])
    is_equivalent: Array = jnp.all(is_inside, axis=1) & jnp.any(shifts != 0.0, axis=1)
    travel: Array = jnp.linalg.norm(candidates - start[None], axis=1)
    nearest = jnp.argsort(jnp.where(is_equivalent, travel, jnp.inf))[:NUM_EQUIVALENTS]
    goals = jnp.concatenate([goal[None], candidates[nearest]])
    return goals, jnp.concatenate([jnp.ones(1, bool), is_equivalent[nearest]])


def _is_good(arm: Arm, qpos: Array) -> Array:
    """Returns bool[]: `qpos` (f32[nq]) is finite, inside the limits and free."""
    is_within = jnp.all((qpos >= arm.lower) & (qpos <= arm.upper))  # false for NaN
    return is_within & is_free(arm, forward_kinematics(arm, qpos))


def _check_straight(arm: Arm, config: PlanningConfig, problems: PlanningProblem, is_open: Array) -> Array:
    """Returns bool[N]: the straight path is proven free; False where not `is_open`."""

    def reset(problem: PlanningProblem, edge: Edge, is_new: Array) -> Edge:
        fresh = edge_between(arm, problem.start, problem.goal)
        return tree_where(is_new, fresh, edge)

    job = lane_pool.Job(
        reset,
        lambda problem, edge: check_edge(arm, edge, problem.qpos, config),
        is_decided,
        lambda _, edge: is_proven_free(edge),
        has_stragglers=False,
    )
    origin = jnp.zeros(problems.start.shape[1])
    states = _repeat_for_lanes(edge_between(arm, origin, origin), is_open.shape[0])
    return lane_pool.run(job, problems, lane_pool.queue_where(is_open), states, jnp.zeros(is_open.shape[0], bool))


def _grow_trees(
    arm: Arm,
    config: PlanningConfig,
    is_bidirectional: bool,
    problems: PlanningProblem,
    is_open: Array,
    paths: _Paths,
) -> _Paths:
    """Returns paths by trees where `is_open` (bool[N]), the given paths elsewhere."""

    def path_of_lane(_: PlanningProblem, state: trees.Trees) -> _Paths:
        waypoints, count = trees.extract_path(config, state)
        return _Paths(waypoints, count, state.is_found & (count <= config.max_waypoints))

    job = lane_pool.Job(
        functools.partial(trees.reset_lane, arm, config),
        functools.partial(trees.step_lane, arm, config, is_bidirectional),
        lambda state: state.is_done,
        path_of_lane,
    )
    queue = lane_pool.queue_where(is_open)
    states = _repeat_for_lanes(trees.empty_lane(arm, config), is_open.shape[0])
    return lane_pool.run(job, problems, queue, states, paths)


def _shorten(arm: Arm, config: PlanningConfig, paths: PathToShorten, is_open: Array) -> Array:
    """Returns waypoints f32[N, W, J], shortened where `is_open` (bool[N])."""
    job = lane_pool.Job(
        functools.partial(shortcuts.reset_lane, arm),
        functools.partial(shortcuts.step_lane, arm, config),
        functools.partial(shortcuts.is_lane_done, config),
        lambda _, state: state.waypoints,
        has_stragglers=False,
    )
    states = _repeat_for_lanes(shortcuts.empty_lane(arm, config), is_open.shape[0])
    return lane_pool.run(job, paths, lane_pool.queue_where(is_open), states, paths.waypoints)


def _repeat_for_lanes(state: State, num_problems: int) -> State:
    """Returns `state` with a leading axis, one row for each lane."""
    num_lanes = min(lane_counts.current().rrt, num_problems)
    return jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (num_lanes, *leaf.shape)), state)
