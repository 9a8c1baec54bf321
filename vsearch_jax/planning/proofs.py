"""What proves that nothing touches between two samples of a straight joint path.

A distance changes by no more than the way that the solids move against one another. So two samples prove all between
them free where, for every pair, their distances add up to more than that way. Two bounds of it are known:

- The joints' changes times the pair's levers (`Pairs.levers`), which holds between any two configurations.
- Where one of the pair stands still: the chord between the two places of the other one, and how far the arc may stray
  from it. A point whose second derivative along the edge is at most c strays by c t^2 / 8 over a share t of the edge.

Above the table only the height counts, which lies between those of the ends of the chord. Far from everything a few
samples do for a whole edge.

All functions take arrays with a batch axis more at the end, too; see `batches.batch_axis_last`.
"""

from __future__ import annotations

import functools
from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from vsearch_jax.robot import collision, kinematics
from vsearch_jax.robot.arm import Arm
from vsearch_jax.robot.collision import Axes, Pairs, primitives
from vsearch_jax.xla.batching import append_axes
from vsearch_jax.xla.materialize import materialize, runtime_zero

# m, of positions in float32.
ROUNDING = 1e-5


class Sample(NamedTuple):
    """Where the arm is at one configuration; N pairs, C capsules.

    Attributes:
      gap: f32[N] m, distances of the planning pairs, the table's less its clearance, or less than that.
      axes: Axes of the capsules.
    """

    gap: Array
    axes: Axes


class Bounds(NamedTuple):
    """What an edge can do at most, the whole of it; N pairs, C capsules.

    Attributes:
      rate: f32[N] m, by which the motion shortens the distances.
      bend: f32[C] m, second derivative of any point of a capsule.
    """

    rate: Array
    bend: Array


def look(arm: Arm, qpos: Array) -> Sample:
    """Returns where the arm is at `qpos` (f32[nq])."""
    zero = runtime_zero(qpos)
    # Else what follows computes this anew, the axes for every pair.
    rotations, positions, _, _ = kinematics.frames(arm.joints, materialize(qpos[arm.joints.address], zero))
    pairs = arm.planning_pairs
    axes = materialize(collision.capsule_axes(pairs, rotations, positions), zero)
    gap = collision.distances_from_axes(pairs, axes, arm.table_height)
    margin = jnp.where(pairs.part == collision.TABLE, arm.table_clearance, 0.0)
    return Sample(gap - append_axes(margin, qpos.ndim - 1), axes)


def motion_bounds(pairs: Pairs, change: Array) -> Bounds:
    """Returns the bounds of the edge on which the joints of the chain change by `change` (f32[J] rad or m)."""
    wide = functools.partial(append_axes, count=change.ndim - 1)
    turns = jnp.abs(change)
    before = jnp.cumsum(turns, axis=0) - turns
    # Joint k, turning by w_k, gives a point the speed w_k r_k; it turns that itself, every joint before it twice.
    bend = jnp.sum(wide(pairs.reach) * (turns * (turns + 2.0 * before))[None], axis=1)
    return Bounds(jnp.sum(wide(pairs.levers) * turns[None], axis=1), bend)


def ways(before: Axes, after: Axes) -> tuple[Array, Array]:
    """Returns how far in m the capsules have moved, f32[C], and how far downward, f32[C]."""
    middle, end = (
        primitives.subtract(after.center, before.center),
        primitives.subtract(after.half_axis, before.half_axis),
    )
    one = jnp.ones_like(middle[0])
    moves = [primitives.add_scaled(middle, sign * one, end) for sign in (1.0, -1.0)]
    way = jnp.maximum(*(primitives.length(move) for move in moves))
    return way, jnp.maximum(-jnp.minimum(*(move[2] for move in moves)), 0.0)


def is_free_between(pairs: Pairs, ends: tuple[Sample, Sample], step: Array, bounds: Bounds, way: Array) -> Array:
    """Returns bool[]: nothing touches between two samples of an edge.

    Args:
      pairs: the planning pairs.
      ends: the samples.
      step: f32[], the share of the edge between them.
      bounds: of the edge.
      way: f32[C] m, how far the capsules have moved from one to the other.
    """
    wide = functools.partial(append_axes, count=step.ndim)
    gap, step = ends[0].gap + ends[1].gap, step[None]
    by_levers = gap >= bounds.rate * step + ROUNDING
    stray = (bounds.bend * step * step)[pairs.mover]
    by_chord = gap >= way[pairs.mover] + 0.25 * stray + ROUNDING
    by_height = jnp.minimum(ends[0].gap, ends[1].gap) >= 0.125 * stray + ROUNDING
    by_place = jnp.where(wide(pairs.part == collision.TABLE), by_height, by_chord)
    return jnp.all(by_levers | (wide(pairs.is_still) & by_place), axis=0)
