"""Is the straight joint path between two configurations free? Proven by distances, not sampled.

Where a pair of solids is d apart, no motion that shifts them by less than d against one another lets them touch. So two
samples prove all between them free where, for every pair, their distances add up to more than the motion between them
can take away (`Pairs.levers`). Far from everything a few samples do for a whole edge.
"""

from __future__ import annotations

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from vsearch_jax import collision, kinematics
from vsearch_jax.arm import Arm
from vsearch_jax.config import PlanningConfig

# A step this many times the distance is tried first: the next sample is mostly as far from everything as this one, and
# 2 would need it to be no nearer at all. The safe step follows where that fails.
BOLD = 1.8
# Where an edge is looked at first: most of those that are blocked show it here, for a few samples instead of the dozens
# that it takes to come up to what blocks them.
PROBES = (1.0, 0.5, 0.25, 0.75, 0.125, 0.375, 0.625, 0.875)


class Edge(NamedTuple):
    """A straight joint path that is being checked; N pairs.

    Attributes:
      start: f32[J] rad or m.
      change: f32[J] rad or m, from the start to the end.
      done: f32[] in [0, 1], the share of the path that is proven free.
      gap: f32[N] m, distances there, or less.
      boldness: f32[], factor of the next step.
      num_probes: i32[], how many of the `PROBES` are done.
      is_blocked: bool[], a probe touches or the next step cannot be proven.
    """

    start: Array
    change: Array
    done: Array
    gap: Array
    boldness: Array
    num_probes: Array
    is_blocked: Array


def edge_between(arm: Arm, start: Array, end: Array) -> Edge:
    """Returns the edge from `start` to `end` (f32[J] each), of which nothing is proven yet; the start must be free."""
    gap = jnp.zeros(arm.planning_pairs.part.shape[0])
    return Edge(start, end - start, jnp.float32(0.0), gap, jnp.float32(BOLD), jnp.int32(0), jnp.bool_(False))


def is_whole(edge: Edge) -> Array:
    """Returns bool[]: the whole edge is proven free."""
    return edge.done >= 1.0


def is_settled(edge: Edge) -> Array:
    """Returns bool[]: the edge is free or blocked; more steps change nothing."""
    return is_whole(edge) | edge.is_blocked


def reached(edge: Edge) -> Array:
    """Returns f32[J], the last configuration to which the edge is proven free."""
    return edge.start + edge.done * edge.change


def planning_gaps(arm: Arm, qpos: Array) -> Array:
    """Returns f32[N] m, how far each of the planning pairs is from being too near, at `qpos` (f32[nq])."""
    rotations, positions, _, _ = kinematics.frames(arm.joints, qpos[arm.joints.address])
    pairs = arm.planning_pairs
    gap = collision.gaps_from_frames(pairs, rotations, positions, arm.table_height)
    return gap - jnp.where(pairs.part == collision.TABLE, arm.table_clearance, 0.0)


def advance(arm: Arm, edge: Edge, qpos: Array, config: PlanningConfig) -> Edge:
    """Returns the edge after one more probe or sample; `qpos` (f32[nq]) holds the joints that stay."""
    rate = jnp.sum(arm.planning_pairs.levers * jnp.abs(edge.change)[None], axis=-1)  # m for the whole edge
    # A little less than what is proven, since all is computed in float32.
    room = (edge.boldness * edge.gap + config.resolution) / jnp.maximum(rate, 1e-9)
    is_probing = edge.num_probes < len(PROBES)
    probe = jnp.asarray(PROBES)[jnp.minimum(edge.num_probes, len(PROBES) - 1)]
    done = jnp.where(is_probing, probe, jnp.minimum(edge.done + jnp.min(room), 1.0))
    gap = planning_gaps(arm, qpos.at[arm.chain.address].set(edge.start + done * edge.change))
    is_clear = jnp.all(gap > 0.0)
    is_proven = is_clear & jnp.all(edge.gap + gap >= rate * (done - edge.done) * (1.0 + 1e-4)) & ~is_probing
    is_bold = edge.boldness > 1.0
    new = edge._replace(
        done=jnp.where(is_proven, done, edge.done),
        gap=jnp.where(is_proven, gap, edge.gap),
        boldness=jnp.where(is_proven | is_probing, BOLD, 1.0),
        num_probes=edge.num_probes + is_probing.astype(jnp.int32),
        is_blocked=jnp.where(is_probing, ~is_clear, ~is_proven & ~is_bold),
    )
    return jax.tree.map(lambda a, b: jnp.where(is_settled(edge), b, a), new, edge)


def edge_is_free(arm: Arm, start: Array, end: Array, config: PlanningConfig) -> Array:
    """Returns bool[]: nothing touches and the table's clearance is kept all along the straight joint path.

    True is a proof: there is no resolution below which a contact may slip through. False may also mean that the arm
    passes within `config.resolution` of something, where the proof is given up. Ellipsoids count as the capsules around
    them (see `collision.build_pairs`). For more than a few edges at once `rrt_connect` is faster, since its edges do
    not wait for the slowest.

    Args:
      arm: the arm.
      start: f32[nq] rad or m; it must be free itself.
      end: f32[nq] rad or m; joints that do not move the camera stay as they are at the start.
      config: the resolution.
    """
    address = arm.chain.address
    edge = edge_between(arm, start[address], end[address])
    step = functools.partial(advance, arm, qpos=start, config=config)
    return is_whole(jax.lax.while_loop(lambda edge: ~is_settled(edge), step, edge))
