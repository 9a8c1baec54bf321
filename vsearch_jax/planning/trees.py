"""Rapidly exploring random trees between two configurations, one problem a lane.

Sources: LaValle, Rapidly-exploring random trees (1998); Kuffner and LaValle, RRT-Connect (ICRA 2000).
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from vsearch_jax.config import PlanningConfig
from vsearch_jax.planning.edges import Edge, advance, edge_between, is_settled, is_whole, reached
from vsearch_jax.robot.arm import Arm
from vsearch_jax.xla.tree import tree_where

# Samples of an edge between two looks at the trees, which cost about half as much as one sample.
SAMPLES_PER_STEP = 2
# An edge that is blocked before this share of `config.step` adds no node.
LEAST_PROGRESS = 0.05


class Problem(NamedTuple):
    """From `start` to `goal` (f32[J] rad or m), with the other joints of `qpos` (f32[nq]) at rest, and its key."""

    start: Array
    goal: Array
    qpos: Array
    key: Array


class Trees(NamedTuple):
    """A lane: two trees, the one of the start first, and the edge being checked; M nodes at most.

    Attributes:
      nodes: f32[2, M + 1, J] rad or m; the last row takes what is not kept.
      parents: i32[2, M + 1].
      counts: i32[2], nodes of each tree.
      edge: Edge from node `origin` of tree `tree`.
      tree: i32[].
      origin: i32[].
      is_connecting: bool[], the edge leads to the newest node of the other tree; else to a random configuration.
      iterations: i32[], edges checked.
      is_found: bool[], the trees meet in the newest node of each.
      is_done: bool[].
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


def empty(arm: Arm, config: PlanningConfig) -> Trees:
    """Returns a lane that `begin` can use."""
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


def begin(arm: Arm, config: PlanningConfig, problem: Problem, trees: Trees, is_new: Array) -> Trees:
    """Plants start and goal where `is_new`; nodes of an earlier problem stay and are written over."""
    row = jnp.where(is_new, 0, config.num_nodes)
    nodes = trees.nodes.at[jnp.arange(2), row].set(jnp.stack([problem.start, problem.goal]))
    first = edge_between(arm, problem.start, _toward(problem.start, _sample(arm, problem, 0), config))
    fresh = trees._replace(
        counts=jnp.ones(2, jnp.int32),
        edge=first,
        tree=jnp.int32(0),
        origin=jnp.int32(0),
        is_connecting=jnp.bool_(False),
        iterations=jnp.int32(0),
        is_found=jnp.bool_(False),
        is_done=jnp.bool_(False),
    )
    small = tree_where(is_new, fresh._replace(nodes=(), parents=()), trees._replace(nodes=(), parents=()))
    return small._replace(nodes=nodes, parents=trees.parents)


def step(arm: Arm, config: PlanningConfig, is_bidirectional: bool, problem: Problem, trees: Trees) -> Trees:
    """Looks at some samples of the edge; where it is settled, keeps what it reached and starts the next."""
    edge = advance(arm, trees.edge, problem.qpos, config, SAMPLES_PER_STEP)
    is_ready = is_settled(edge) & ~trees.is_done
    progress = jnp.linalg.norm(edge.done * edge.change)
    is_kept = is_ready & (is_whole(edge) | (progress > LEAST_PROGRESS * config.step))
    is_kept = is_kept & (is_bidirectional | ~trees.is_connecting | is_whole(edge))
    row = jnp.where(is_kept, trees.counts[trees.tree], config.num_nodes)
    nodes = trees.nodes.at[trees.tree, row].set(reached(edge))
    parents = trees.parents.at[trees.tree, row].set(trees.origin)
    counts = trees.counts.at[trees.tree].add(is_kept.astype(jnp.int32))
    is_found = trees.is_found | (is_ready & trees.is_connecting & is_whole(edge))
    iterations = trees.iterations + is_ready.astype(jnp.int32)
    is_spent = jnp.any(counts >= config.num_nodes) | (iterations >= config.max_iterations)
    new = trees._replace(nodes=nodes, parents=parents, counts=counts)
    tree, origin, target, is_connecting = _next(arm, config, is_bidirectional, problem, new, (edge, is_kept))
    following = edge_between(arm, nodes[tree, origin], target)
    return new._replace(
        edge=tree_where(is_ready, following, edge),
        tree=jnp.where(is_ready & ~is_found, tree, trees.tree),
        origin=jnp.where(is_ready, origin, trees.origin),
        is_connecting=jnp.where(is_ready, is_connecting, trees.is_connecting),
        iterations=iterations,
        is_found=is_found,
        is_done=trees.is_done | is_found | (is_ready & is_spent),
    )


def _next(
    arm: Arm, config: PlanningConfig, is_bidirectional: bool, problem: Problem, trees: Trees, last: tuple[Edge, Array]
) -> tuple[Array, Array, Array, Array]:
    """Returns tree, node and target of the edge that follows, and whether it connects the trees.

    After a random edge that got on, the other tree tries to reach the new node; else a tree grows towards a sample: the
    one that has just been connected to, or the other one after an edge without progress.
    """
    edge, is_kept = last
    is_connecting = ~trees.is_connecting & is_kept
    grows = jnp.where(trees.is_connecting, trees.tree, 1 - trees.tree) if is_bidirectional else jnp.int32(0)
    tree = jnp.where(is_connecting, 1 - trees.tree, grows)
    sample = _sample(arm, problem, trees.iterations + 1)
    query = jnp.where(is_connecting, reached(edge), sample)
    squared = jnp.sum((trees.nodes[tree] - query[None]) ** 2, axis=-1)
    origin = jnp.argmin(jnp.where(jnp.arange(squared.shape[0]) < trees.counts[tree], squared, jnp.inf))
    origin = origin.astype(jnp.int32)
    target = jnp.where(is_connecting, query, _toward(trees.nodes[tree, origin], query, config))
    return tree, origin, target, is_connecting


def _sample(arm: Arm, problem: Problem, index: int | Array) -> Array:
    address = arm.chain.address
    lower, upper = arm.lower[address], arm.upper[address]
    share = jax.random.uniform(jax.random.fold_in(problem.key, index), lower.shape)
    return lower + share * (upper - lower)


def _toward(origin: Array, target: Array, config: PlanningConfig) -> Array:
    change = target - origin
    length = jnp.sqrt(jnp.maximum(jnp.sum(change * change), 1e-12))
    return origin + change * jnp.minimum(1.0, config.step / length)


def waypoints(config: PlanningConfig, trees: Trees) -> tuple[Array, Array]:
    """Returns the path over the trees f32[W, J], its end repeated, and i32[], its configurations; W + 1 if too many."""
    depth = config.max_waypoints
    chains, lengths = jax.vmap(_chain, in_axes=(0, 0, None))(trees.parents, trees.counts - 1, depth)
    count = jnp.minimum(lengths[0] + lengths[1] - 1, depth + 1)  # the trees meet in one configuration
    place = jnp.minimum(jnp.arange(depth), count - 1)
    is_first = place < lengths[0]
    first = chains[0][jnp.clip(lengths[0] - 1 - place, 0, depth - 1)]
    second = chains[1][jnp.clip(place - lengths[0] + 1, 0, depth - 1)]
    return trees.nodes[jnp.where(is_first, 0, 1), jnp.where(is_first, first, second)], count


def _chain(parents: Array, leaf: Array, depth: int) -> tuple[Array, Array]:
    """Returns the nodes i32[depth] from `leaf` to the root, which repeats, and their number, at most depth + 1."""
    _, chain = jax.lax.scan(lambda node, _: (jnp.where(node > 0, parents[node], 0), node), leaf, length=depth + 1)
    return chain[:depth], jnp.minimum(jnp.sum(chain > 0) + 1, depth + 1)
