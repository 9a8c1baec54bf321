"""Rapidly exploring random trees (RRT) between two configurations, one problem for each lane.

Sources: LaValle, Rapidly-exploring random trees (1998); Kuffner and LaValle, RRT-Connect (ICRA 2000).
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from vsearch_jax.config import PlanningConfig
from vsearch_jax.planning.edges import (
    Edge,
    check_edge,
    edge_between,
    is_decided,
    is_proven_free,
    last_free_configuration,
)
from vsearch_jax.robot.arm import Arm
from vsearch_jax.xla.tree import tree_where

# Samples of an edge between two updates of the trees. An update costs about half as much as one sample.
SAMPLES_PER_STEP = 2
# An edge that is blocked before this share of `config.step` adds no node.
MIN_PROGRESS = 0.05


class PlanningProblem(NamedTuple):
    """One planning problem. J joints move the camera.

    Attributes:
      start: f32[J] rad or m, joint values at the start.
      goal: f32[J] rad or m, joint values at the goal.
      qpos: f32[nq] rad or m. It supplies the values of the joints that do not move the camera.
      key: PRNG key of the random configurations.
    """

    start: Array
    goal: Array
    qpos: Array
    key: Array


class Trees(NamedTuple):
    """State of a lane, which solves one planning problem at a time: two trees and the edge that is being checked.

    The first tree is that of the start. Each has at most M nodes. An edge is a straight joint path. J joints move the
    camera.

    Attributes:
      nodes: f32[2, M + 1, J] rad or m. The last row is scratch space for nodes that are not kept.
      parents: i32[2, M + 1], number of each node's parent in its tree.
      counts: i32[2], number of nodes of each tree.
      edge: Edge from node `origin` of tree `tree`.
      tree: i32[], 0 or 1.
      origin: i32[], number of a node.
      is_connecting: bool[]. True: the edge leads to the newest node of the other tree. False: to a random
        configuration.
      iterations: i32[], number of edges checked.
      is_found: bool[], the newest nodes of the two trees are the same configuration.
      is_done: bool[], a path is found, or nodes or iterations ran out.
    """

    nodes: Array
    parents: Array
    counts: Array
    edge: Edge
    tree: Array
    origin: Array
    is_connecting: Array
    iterations: Array
    is_found: Array
    is_done: Array


class _NextEdge(NamedTuple):
    """The edge that follows.

    Attributes:
      tree: i32[], tree that grows.
      origin: i32[], node from which it grows.
      target: f32[J] rad or m.
      is_connecting: bool[], see `Trees`.
    """

    tree: Array
    origin: Array
    target: Array
    is_connecting: Array


def empty_lane(arm: Arm, config: PlanningConfig) -> Trees:
    """Returns the state of a lane (a slot that solves one planning problem at a time) that holds no problem yet.

    Args:
      arm: the arm.
      config: `num_nodes` is the number of nodes of a tree.
    """
    count = arm.chain.address.shape[0]
    zero, no = jnp.int32(0), jnp.bool_(False)
    origin = jnp.zeros(count)
    return Trees(
        nodes=jnp.zeros((2, config.num_nodes + 1, count)),
        parents=jnp.zeros((2, config.num_nodes + 1), jnp.int32),
        counts=jnp.zeros(2, jnp.int32),
        edge=edge_between(arm, origin, origin),
        tree=zero,
        origin=zero,
        is_connecting=no,
        iterations=zero,
        is_found=no,
        is_done=no,
    )


def reset_lane(arm: Arm, config: PlanningConfig, problem: PlanningProblem, trees: Trees, is_new: Array) -> Trees:
    """Gives a lane (a slot that solves one planning problem at a time) a new problem.

    Each tree then has one node: start or goal. Nodes of the previous problem stay in memory and are overwritten later.

    Args:
      arm: the arm.
      config: `step` is the length of random edges (straight joint paths).
      problem: the new problem.
      trees: present state of the lane.
      is_new: bool[], whether the lane takes the new problem.

    Returns:
      The state with the new problem where `is_new`, else `trees`.
    """
    row = jnp.where(is_new, 0, config.num_nodes)
    nodes = trees.nodes.at[jnp.arange(2), row].set(jnp.stack([problem.start, problem.goal]))
    target = _steer(problem.start, _random_configuration(arm, problem, 0), config)
    edge = edge_between(arm, problem.start, target)
    fresh = trees._replace(
        counts=jnp.ones(2, jnp.int32),
        edge=edge,
        tree=jnp.int32(0),
        origin=jnp.int32(0),
        is_connecting=jnp.bool_(False),
        iterations=jnp.int32(0),
        is_found=jnp.bool_(False),
        is_done=jnp.bool_(False),
    )
    # The large buffers are left out of the selection, which would copy them.
    small = tree_where(is_new, fresh._replace(nodes=(), parents=()), trees._replace(nodes=(), parents=()))
    return small._replace(nodes=nodes, parents=trees.parents)


def step_lane(
    arm: Arm, config: PlanningConfig, is_bidirectional: bool, problem: PlanningProblem, trees: Trees
) -> Trees:
    """Continues the contact check of the lane's edge by a few samples, and grows a tree if the check is complete.

    A lane is a slot that solves one planning problem at a time. An edge is a straight joint path from a node of a tree.
    When its check is complete, the end of its free part becomes a node, and the next edge is proposed.

    Args:
      arm: the arm.
      config: numbers of nodes and edges; length of edges; resolution of the contact check.
      is_bidirectional: True for RRT-Connect. False for a single tree, whose connecting edges must reach the goal.
      problem: the problem that the lane solves.
      trees: state of the lane.

    Returns:
      The next state; unchanged if the lane is done.
    """
    edge = check_edge(arm, trees.edge, problem.qpos, config, SAMPLES_PER_STEP)
    is_ready = is_decided(edge) & ~trees.is_done
    progress = jnp.linalg.norm(edge.proven * edge.change)
    is_kept = is_ready & (is_proven_free(edge) | (progress > MIN_PROGRESS * config.step))
    is_kept = is_kept & (is_bidirectional | ~trees.is_connecting | is_proven_free(edge))
    row = jnp.where(is_kept, trees.counts[trees.tree], config.num_nodes)
    nodes = trees.nodes.at[trees.tree, row].set(last_free_configuration(edge))
    parents = trees.parents.at[trees.tree, row].set(trees.origin)
    counts = trees.counts.at[trees.tree].add(is_kept.astype(jnp.int32))
    is_found = trees.is_found | (is_ready & trees.is_connecting & is_proven_free(edge))
    iterations = trees.iterations + is_ready.astype(jnp.int32)
    is_spent = jnp.any(counts >= config.num_nodes) | (iterations >= config.max_iterations)
    new = trees._replace(nodes=nodes, parents=parents, counts=counts)
    following = _choose_next_edge(arm, config, is_bidirectional, problem, new, (edge, is_kept))
    next_edge = edge_between(arm, nodes[following.tree, following.origin], following.target)
    return new._replace(
        edge=tree_where(is_ready, next_edge, edge),
        tree=jnp.where(is_ready & ~is_found, following.tree, trees.tree),
        origin=jnp.where(is_ready, following.origin, trees.origin),
        is_connecting=jnp.where(is_ready, following.is_connecting, trees.is_connecting),
        iterations=iterations,
        is_found=is_found,
        is_done=trees.is_done | is_found | (is_ready & is_spent),
    )


def _choose_next_edge(
    arm: Arm,
    config: PlanningConfig,
    is_bidirectional: bool,
    problem: PlanningProblem,
    trees: Trees,
    last: tuple[Edge, Array],
) -> _NextEdge:
    """Returns the edge after `last`, which is an edge and bool[] whether it added a node.

    If a random edge added a node, the other tree tries to connect to that node. In all other cases a tree grows towards
    a new random configuration: after a connecting edge the tree that grew last, otherwise the other tree.
    """
    edge, is_kept = last
    is_connecting = ~trees.is_connecting & is_kept
    growing = jnp.where(trees.is_connecting, trees.tree, 1 - trees.tree) if is_bidirectional else jnp.int32(0)
    tree = jnp.where(is_connecting, 1 - trees.tree, growing)
    random_configuration = _random_configuration(arm, problem, trees.iterations + 1)
    query = jnp.where(is_connecting, last_free_configuration(edge), random_configuration)
    squared = jnp.sum((trees.nodes[tree] - query[None]) ** 2, axis=-1)
    origin = jnp.argmin(jnp.where(jnp.arange(squared.shape[0]) < trees.counts[tree], squared, jnp.inf))
    origin = origin.astype(jnp.int32)
    target = jnp.where(is_connecting, query, _steer(trees.nodes[tree, origin], query, config))
    return _NextEdge(tree, origin, target, is_connecting)


def _random_configuration(arm: Arm, problem: PlanningProblem, index: int | Array) -> Array:
    """Returns f32[J], random configuration number `index` inside the limits."""
    address = arm.chain.address
    lower, upper = arm.lower[address], arm.upper[address]
    share = jax.random.uniform(jax.random.fold_in(problem.key, index), lower.shape)
    return lower + share * (upper - lower)


def _steer(origin: Array, target: Array, config: PlanningConfig) -> Array:
    """Returns the configuration at most `config.step` from `origin` on the straight line to `target`."""
    change = target - origin
    length = jnp.sqrt(jnp.maximum(jnp.sum(change * change), 1e-12))
    return origin + change * jnp.minimum(1.0, config.step / length)


def extract_path(config: PlanningConfig, trees: Trees) -> tuple[Array, Array]:
    """Returns the path from start to goal through two trees that have met.

    Args:
      config: `max_waypoints` is W, the number of waypoints.
      trees: two trees whose newest nodes are the same configuration.

    Returns:
      Waypoints f32[W, J] rad or m of the J joints that move the camera; the last waypoint fills the remaining rows.
      Number of waypoints, i32[]; W + 1 if the path has more than W.
    """
    depth = config.max_waypoints
    chains, lengths = jax.vmap(_path_to_root, in_axes=(0, 0, None))(trees.parents, trees.counts - 1, depth)
    count = jnp.minimum(lengths[0] + lengths[1] - 1, depth + 1)  # both chains hold the common configuration
    place = jnp.minimum(jnp.arange(depth), count - 1)
    is_first = place < lengths[0]
    first = chains[0][jnp.clip(lengths[0] - 1 - place, 0, depth - 1)]
    second = chains[1][jnp.clip(place - lengths[0] + 1, 0, depth - 1)]
    return trees.nodes[jnp.where(is_first, 0, 1), jnp.where(is_first, first, second)], count


def _path_to_root(parents: Array, leaf: Array, depth: int) -> tuple[Array, Array]:
    """Returns the nodes i32[depth] from `leaf` to the root, the root repeated, and their number, at most depth + 1."""
    _, chain = jax.lax.scan(lambda node, _: (jnp.where(node > 0, parents[node], 0), node), leaf, length=depth + 1)
    return chain[:depth], jnp.minimum(jnp.sum(chain > 0) + 1, depth + 1)
