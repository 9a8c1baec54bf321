"""Is the straight joint path between two configurations free? Proven (see `proofs`), after a look at a few samples."""

from __future__ import annotations

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from vsearch_jax.config import PlanningConfig
from vsearch_jax.planning.proofs import Bounds, Sample, is_free_between, look, motion_bounds, ways
from vsearch_jax.robot import collision
from vsearch_jax.robot.arm import Arm
from vsearch_jax.robot.collision import Axes
from vsearch_jax.xla.batching import append_axes, batch_axis_last
from vsearch_jax.xla.tree import tree_where

# A step is as long as if the next sample were nearly as far from everything as this one, and the speed the same. Where
# that fails, a shorter one is tried, then one that is safe wherever the next sample touches nothing.
BOLD = (1.3, 0.7, 1.0)
LAST_TRY = len(BOLD) - 1
# Where an edge is looked at first: most of those that are blocked show it here, for a few samples instead of the dozens
# that it takes to come up to what blocks them. The last two tell the speed at the start.
PROBES = (1.0, 0.5, 0.25, 0.75, 0.375, 0.625, 0.875, 0.125, 0.0)


class Edge(NamedTuple):
    """A straight joint path that is being checked; N pairs, C capsules.

    Attributes:
      start: f32[J] rad or m.
      change: f32[J] rad or m, from the start to the end.
      done: f32[] in [0, 1], the share of the path that is proven free.
      sample: Sample there; the last probe until all are done, which ends there too.
      speed: f32[C] m, that the capsules move on the whole edge at their present speed.
      sink: f32[C] m, the same, but downward only.
      num_tries: i32[], steps from there that could not be proven.
      num_probes: i32[], how many of the `PROBES` are done.
      is_blocked: bool[], a probe touches or the next step cannot be proven.
    """

    start: Array
    change: Array
    done: Array
    sample: Sample
    speed: Array
    sink: Array
    num_tries: Array
    num_probes: Array
    is_blocked: Array


def edge_between(arm: Arm, start: Array, end: Array) -> Edge:
    """Returns the edge from `start` to `end` (f32[J] each), of which nothing is proven yet."""
    pairs = arm.planning_pairs
    still = jnp.zeros(pairs.radius.shape[0])
    sample = Sample(jnp.zeros(pairs.part.shape[0]), Axes((still, still, still), (still, still, still)))
    none = jnp.int32(0)
    return Edge(start, end - start, jnp.float32(0.0), sample, still, still, none, none, jnp.bool_(False))


def is_whole(edge: Edge) -> Array:
    """Returns bool[]: the whole edge is proven free."""
    return edge.done >= 1.0


def is_settled(edge: Edge) -> Array:
    """Returns bool[]: the edge is free or blocked; more steps change nothing."""
    return is_whole(edge) | edge.is_blocked


def reached(edge: Edge) -> Array:
    """Returns f32[J], the last configuration to which the edge is proven free."""
    return edge.start + edge.done * edge.change


def advance(arm: Arm, edge: Edge, qpos: Array, config: PlanningConfig, count: int = 1) -> Edge:
    """Returns the edge after `count` more probes or samples; `qpos` (f32[nq]) holds the joints that stay."""
    advance_all = batch_axis_last(functools.partial(_advance, config.resolution, count))
    return advance_all(arm, (edge, qpos))


def _advance(resolution: float, count: int, arm: Arm, item: tuple[Edge, Array]) -> Edge:
    edge, qpos = item
    bounds = motion_bounds(arm.planning_pairs, edge.change)
    once = functools.partial(_advance_once, arm, qpos, bounds, resolution)
    return jax.lax.fori_loop(0, count, lambda _, edge: once(edge), edge)


def _advance_once(arm: Arm, qpos: Array, bounds: Bounds, resolution: float, edge: Edge) -> Edge:
    pairs = arm.planning_pairs
    is_probing = edge.num_probes < len(PROBES)
    probe = jnp.asarray(PROBES)[jnp.minimum(edge.num_probes, len(PROBES) - 1)]
    step = jnp.minimum(_step(pairs, edge, bounds, resolution), 1.0 - edge.done)
    place = jnp.where(is_probing, probe, edge.done + step)
    sample = look(arm, qpos.at[arm.chain.address].set(edge.start + place[None] * edge.change))
    is_clear = jnp.all(sample.gap > 0.0, axis=0)
    step = place - edge.done  # as it was rounded
    way, fall = ways(edge.sample.axes, sample.axes)
    is_proven = ~is_probing & (step > 0.0) & is_clear & is_free_between(pairs, (edge.sample, sample), step, bounds, way)
    is_new = is_proven | is_probing
    # Steps that come nearer and nearer would never end; those of an arm that starts near something lead away.
    nearest, before = jnp.min(sample.gap, axis=0), jnp.min(edge.sample.gap, axis=0)
    is_too_near = is_proven & (nearest < resolution) & (nearest < before) & (place < 1.0)
    share = jnp.where(is_probing, PROBES[-2] - PROBES[-1], jnp.maximum(step, 1e-9))
    new = edge._replace(
        done=jnp.where(is_proven, place, edge.done),
        sample=tree_where(is_new[None], sample, edge.sample),
        speed=jnp.where(is_new[None], way / share[None], edge.speed),
        sink=jnp.where(is_new[None], jnp.where(is_probing[None], way, fall) / share[None], edge.sink),
        num_tries=jnp.where(is_new, 0, edge.num_tries + 1),
        num_probes=edge.num_probes + is_probing.astype(jnp.int32),
        is_blocked=jnp.where(is_probing, ~is_clear, is_too_near | (~is_proven & (edge.num_tries >= LAST_TRY))),
    )
    stays = is_settled(edge)
    return jax.tree.map(lambda a, b: jnp.where(stays[None] if a.ndim > stays.ndim else stays, b, a), new, edge)


def _step(pairs: collision.Pairs, edge: Edge, bounds: Bounds, resolution: float) -> Array:
    """Returns f32[], the share of the edge to the next sample."""
    wide = functools.partial(append_axes, count=edge.done.ndim)
    gap, boldness = edge.sample.gap, jnp.asarray(BOLD)[jnp.minimum(edge.num_tries, LAST_TRY)][None]
    extra = jnp.where(edge.num_tries == 0, resolution, 0.0)[None]
    by_levers = (boldness * gap + extra) / jnp.maximum(bounds.rate, 1e-9)
    is_table, mover = wide(pairs.part == collision.TABLE), pairs.mover
    # The root of speed t + curve t^2 = reserve.
    reserve = jnp.where(is_table, 0.5, 1.0) * boldness * gap
    speed = jnp.where(is_table, edge.sink[mover], edge.speed[mover])
    curve = jnp.where(is_table, 0.125, 0.25) * bounds.bend[mover]
    by_chord = 2.0 * reserve / (speed + jnp.sqrt(speed * speed + 4.0 * curve * reserve) + 1e-9)
    has_chord = wide(pairs.is_still) & (edge.num_tries < LAST_TRY)[None]
    return jnp.min(jnp.where(has_chord, jnp.maximum(by_levers, by_chord), by_levers), axis=0)


def edge_is_free(arm: Arm, start: Array, end: Array, config: PlanningConfig) -> Array:
    """Returns bool[]: nothing touches and the table's clearance is kept all along the straight joint path.

    True is a proof: there is no resolution below which a contact may slip through. False may also mean that the arm
    comes within `config.resolution` of something and nearer, where the proof is given up; it may start and end there.
    Ellipsoids count as the capsules around them (see `collision.build_pairs`). For more than a few edges at once
    `rrt_connect` is faster, since its edges do not wait for the slowest.

    Args:
      arm: the arm.
      start: f32[nq] rad or m.
      end: f32[nq] rad or m; joints that do not move the camera stay as they are at the start. That both are inside
        the limits is not looked at.
      config: the resolution.
    """
    address = arm.chain.address
    edge = edge_between(arm, start[address], end[address])
    step = functools.partial(advance, arm, qpos=start, config=config)
    return is_whole(jax.lax.while_loop(lambda edge: ~is_settled(edge), step, edge))
