"""Checks whether the straight joint path between two configurations (an edge) is free.

First a few samples are checked for contact. Then the edge is proven free step by step; see `planning.proofs`.
"""

from __future__ import annotations

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from vsearch_jax.config import PlanningConfig
from vsearch_jax.planning.proofs import (
    EdgeBounds,
    EdgeSample,
    displacements,
    edge_bounds,
    evaluate_sample,
    is_free_between,
)
from vsearch_jax.robot import collision
from vsearch_jax.robot.arm import Arm
from vsearch_jax.robot.collision import Axes, Frames
from vsearch_jax.xla.batching import append_axes, batch_axis_last
from vsearch_jax.xla.tree import tree_where

# A step is proven if the distances at its two ends add up to more than the motion between them. Attempt i assumes that
# this sum is BOLDNESS[i] times the distance at the start. The last attempt uses the levers alone: it succeeds whenever
# its sample is free.
BOLDNESS = (1.3, 0.7, 1.0)
LAST_ATTEMPT = len(BOLDNESS) - 1
# Shares of the edge that are checked first. Most blocked edges are in contact at one of them, which saves the many
# samples up to the contact. The last two samples give the speed at the start.
PROBES = (1.0, 0.5, 0.25, 0.75, 0.375, 0.625, 0.875, 0.125, 0.0)


class Edge(NamedTuple):
    """A straight joint path and how far it is proven free of contact. C capsules, S bodies, J chain joints.

    Attributes:
      start: f32[J] rad or m, joint values at the start.
      change: f32[J] rad or m, joint values at the end less those at the start.
      proven: f32[] in [0, 1], share of the path that is proven free of contact.
      sample: EdgeSample at `proven`. During the probes it is that of the last probe; the last probe is at 0.
      speed: f32[C + S] m, distance that each geom would move on the whole edge at its present speed.
      sink: f32[C + S] m, downward part of that distance.
      num_failures: i32[], steps from `proven` that could not be proven free.
      num_probes: i32[], number of the `PROBES` that are done.
      is_blocked: bool[], a probe is in contact or no step could be proven free.
    """

    start: Array
    change: Array
    proven: Array
    sample: EdgeSample
    speed: Array
    sink: Array
    num_failures: Array
    num_probes: Array
    is_blocked: Array


def edge_between(arm: Arm, start: Array, end: Array) -> Edge:
    """Returns the edge (straight joint path) from `start` to `end`; nothing of it is checked for contact yet.

    Args:
      arm: the arm.
      start: f32[J] rad or m, values of the J joints that move the camera, at the start of the edge.
      end: f32[J] rad or m, values of these joints at the end of the edge.
    """
    pairs = arm.planning_pairs
    none, still = jnp.zeros(pairs.radius.shape[0]), jnp.zeros(pairs.reach.shape[0])
    at_origin = jnp.zeros(pairs.bodies.geom.shape[0])
    origin = (at_origin, at_origin, at_origin)
    axes, frames = Axes((none, none, none), (none, none, none)), Frames(origin, (origin, origin, origin))
    sample, zero = EdgeSample(jnp.zeros(pairs.part.shape[0]), axes, frames), jnp.int32(0)
    return Edge(start, end - start, jnp.float32(0.0), sample, still, still, zero, zero, jnp.bool_(False))


def is_proven_free(edge: Edge) -> Array:
    """Returns bool[]: the whole edge (straight joint path) is proven free of contact."""
    return edge.proven >= 1.0


def is_decided(edge: Edge) -> Array:
    """Returns bool[]: the check of the edge is complete, because the edge is proven free of contact or is blocked."""
    return is_proven_free(edge) | edge.is_blocked


def last_free_configuration(edge: Edge) -> Array:
    """Returns the farthest configuration up to which the edge (straight joint path) is proven free of contact.

    The result is f32[J] rad or m, values of the J joints that move the camera.
    """
    return edge.start + edge.proven * edge.change


def check_edge(arm: Arm, edge: Edge, qpos: Array, config: PlanningConfig, num_samples: int = 1) -> Edge:
    """Continues the contact check of an edge (straight joint path) by a few samples.

    A sample is one configuration on the edge at which distances are computed.

    Args:
      arm: the arm.
      edge: the edge, as far as it is checked.
      qpos: f32[nq] rad or m. It supplies the values of the joints that do not move the camera.
      config: `resolution` is the smallest gap to an obstacle.
      num_samples: number of samples to take.

    Returns:
      The edge after these samples. It is unchanged if it was already proven free or blocked.
    """
    check = batch_axis_last(functools.partial(_take_samples, config.resolution, num_samples))
    return check(arm, (edge, qpos))


def _take_samples(resolution: float, num_samples: int, arm: Arm, item: tuple[Edge, Array]) -> Edge:
    edge, qpos = item
    bounds = edge_bounds(arm.planning_pairs, edge.change)
    take = functools.partial(_take_sample, arm, qpos, bounds, resolution)
    return jax.lax.fori_loop(0, num_samples, lambda _, edge: take(edge), edge)


def _take_sample(arm: Arm, qpos: Array, bounds: EdgeBounds, resolution: float, edge: Edge) -> Edge:
    """Takes the next probe, or tries to prove the next step."""
    pairs = arm.planning_pairs
    is_probe, place = _choose_place(pairs, edge, bounds, resolution)
    sample = evaluate_sample(arm, qpos.at[arm.chain.address].set(edge.start + place[None] * edge.change))
    is_clear = jnp.all(sample.gap > 0.0, axis=0)
    step = place - edge.proven  # the step after rounding
    distance, fall = displacements(pairs, edge.sample, sample)
    is_proven = (
        ~is_probe & (step > 0.0) & is_clear & is_free_between(pairs, (edge.sample, sample), step, bounds, distance)
    )
    is_new = is_proven | is_probe
    # Ever shorter steps towards a contact would not end. Steps away from a close start are allowed.
    nearest, before = jnp.min(sample.gap, axis=0), jnp.min(edge.sample.gap, axis=0)
    is_too_near = is_proven & (nearest < resolution) & (nearest < before) & (place < 1.0)
    share = jnp.where(is_probe, PROBES[-2] - PROBES[-1], jnp.maximum(step, 1e-9))
    new = edge._replace(
        proven=jnp.where(is_proven, place, edge.proven),
        sample=tree_where(is_new[None], sample, edge.sample),
        speed=jnp.where(is_new[None], distance / share[None], edge.speed),
        sink=jnp.where(is_new[None], jnp.where(is_probe[None], distance, fall) / share[None], edge.sink),
        num_failures=jnp.where(is_new, 0, edge.num_failures + 1),
        num_probes=edge.num_probes + is_probe.astype(jnp.int32),
        is_blocked=jnp.where(is_probe, ~is_clear, is_too_near | (~is_proven & (edge.num_failures >= LAST_ATTEMPT))),
    )
    stays = is_decided(edge)
    return jax.tree.map(lambda a, b: jnp.where(stays[None] if a.ndim > stays.ndim else stays, b, a), new, edge)


def _choose_place(pairs: collision.Pairs, edge: Edge, bounds: EdgeBounds, resolution: float) -> tuple[Array, Array]:
    """Returns bool[] whether the next sample is a probe, and f32[] in [0, 1] its place on the edge."""
    is_probe = edge.num_probes < len(PROBES)
    probe = jnp.asarray(PROBES)[jnp.minimum(edge.num_probes, len(PROBES) - 1)]
    step = jnp.minimum(_step_length(pairs, edge, bounds, resolution), 1.0 - edge.proven)
    return is_probe, jnp.where(is_probe, probe, edge.proven + step)


def _step_length(pairs: collision.Pairs, edge: Edge, bounds: EdgeBounds, resolution: float) -> Array:
    """Returns f32[], share of the edge from `edge.proven` to the next sample."""
    with_batch_axes = functools.partial(append_axes, count=edge.proven.ndim)
    gap, boldness = edge.sample.gap, jnp.asarray(BOLDNESS)[jnp.minimum(edge.num_failures, LAST_ATTEMPT)][None]
    extra = jnp.where(edge.num_failures == 0, resolution, 0.0)[None]
    by_levers = (boldness * gap + extra) / jnp.maximum(bounds.rate, 1e-9)
    is_table, mover = with_batch_axes(pairs.part == collision.TABLE), pairs.mover
    # The step t solves speed * t + curve * t^2 = reserve.
    reserve = jnp.where(is_table, 0.5, 1.0) * boldness * gap
    speed = jnp.where(is_table, edge.sink[mover], edge.speed[mover])
    curve = jnp.where(is_table, 0.125, 0.25) * bounds.bend[mover]
    by_chord = 2.0 * reserve / (speed + jnp.sqrt(speed * speed + 4.0 * curve * reserve) + 1e-9)
    has_chord = with_batch_axes(pairs.is_still) & (edge.num_failures < LAST_ATTEMPT)[None]
    return jnp.min(jnp.where(has_chord, jnp.maximum(by_levers, by_chord), by_levers), axis=0)


def edge_is_free(arm: Arm, start: Array, end: Array, config: PlanningConfig) -> Array:
    """Returns bool[]: on the whole straight joint path nothing touches and the table's clearance is kept.

    True is a proof: no contact can be missed between samples. False means that there is a contact, or that the path
    leads closer to something that is already nearer than `config.resolution`; then the proof is given up. A path may
    start and end that close. Ellipsoids around the arm count as capsules (see `robot.collision.build_pairs`).

    Under `vmap` every edge waits for the slowest. For many edges `rrt_connect` is faster.

    Args:
      arm: the arm.
      start: f32[nq] rad or m, joint values at the start. Joints that do not move the camera keep these values.
      end: f32[nq] rad or m, joint values at the end. Joint limits are not checked.
      config: `resolution` is the smallest gap to an obstacle.
    """
    address = arm.chain.address
    edge = edge_between(arm, start[address], end[address])
    check = functools.partial(check_edge, arm, qpos=start, config=config)
    return is_proven_free(jax.lax.while_loop(lambda edge: ~is_decided(edge), check, edge))
