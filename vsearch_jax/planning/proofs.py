"""Proof that nothing touches between two samples of a straight joint path.

A distance between two bodies changes by at most the distance that they move. So two samples prove that everything
between them is free if, for every pair, the sum of their two distances is larger than that motion. Two bounds of the
motion are used:

- The joints' changes times the pair's levers (`Pairs.levers`). It holds between any two configurations.
- For a pair of which one body does not move: the chord between the two positions of the moving body, plus the largest
  distance of the arc from the chord. A point whose second derivative along the edge is at most c leaves the chord by
  at most c t^2 / 8 over a share t of the edge.

For the table only heights count. A height between two samples is at least the lower of the two, less that distance from
the chord. Far from everything, a few samples prove a whole edge.

All functions also accept arrays with a batch axis at the end; see `xla.batching.batch_axis_last`.
"""

from __future__ import annotations

import functools
import itertools
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from vsearch_jax.robot import collision, kinematics
from vsearch_jax.robot.arm import Arm
from vsearch_jax.robot.collision import Axes, Frames, Pairs, primitives
from vsearch_jax.xla.batching import append_axes
from vsearch_jax.xla.materialize import materialize, runtime_zero
from vsearch_jax.xla.vectors import Vector, dot

# Rounding error in m of positions in float32.
ROUNDING = 1e-5


class EdgeSample(NamedTuple):
    """Distances and poses of the arm's geoms at one configuration. N pairs of geoms that must not touch.

    Attributes:
      gap: f32[N] m, a lower bound of the distance of each pair. For pairs with the table, the table's clearance is
        subtracted.
      axes: Axes of the C capsules in world.
      frames: poses of the S bodies (`Pairs.bodies`) in world.
    """

    gap: Array
    axes: Axes
    frames: Frames


class EdgeBounds(NamedTuple):
    """Upper bounds for a whole edge (straight joint path). N pairs of geoms that must not touch, C capsules, S bodies.

    Attributes:
      rate: f32[N] m, by which the edge's motion changes each distance.
      bend: f32[C + S] m, second derivative of the position of any point of a capsule or body by the share of the edge.
    """

    rate: Array
    bend: Array


def evaluate_sample(arm: Arm, qpos: Array) -> EdgeSample:
    """Computes the distances of all planning pairs, and the poses of their geoms, at one configuration.

    Args:
      arm: the arm.
      qpos: f32[nq] rad or m, values of all joints.

    Returns:
      The distances and the poses.
    """
    zero = runtime_zero(qpos)
    # Without the two boundaries XLA computes the frames and the axes again for every pair.
    rotations, positions, _, _ = kinematics.frames(arm.joints, materialize(qpos[arm.joints.address], zero))
    pairs = arm.planning_pairs
    axes = materialize(collision.capsule_axes(pairs, rotations, positions), zero)
    frames = collision.body_frames(pairs, rotations, positions)
    if pairs.convex:
        frames = materialize(frames, zero)
    gap = collision.distances_from_poses(pairs, axes, frames, arm.table_height)
    margin = jnp.where(pairs.part == collision.TABLE, arm.table_clearance, 0.0)
    return EdgeSample(gap - append_axes(margin, qpos.ndim - 1), axes, frames)


def edge_bounds(pairs: Pairs, change: Array) -> EdgeBounds:
    """Bounds how far an edge (straight joint path) can change the distances and bend the paths of the geoms.

    Args:
      pairs: the pairs of geoms that planning checks for contact.
      change: f32[J] rad or m, change of the J joints that move the camera from the edge's start to its end.

    Returns:
      Upper bounds for the whole edge.
    """
    with_batch_axes = functools.partial(append_axes, count=change.ndim - 1)
    turns = jnp.abs(change)
    before = jnp.cumsum(turns, axis=0) - turns
    # Joint k at speed w_k gives a point a velocity of at most w_k r_k. In the second derivative this velocity counts
    # once with w_k, and twice with the speed of each joint before joint k.
    bend = jnp.sum(with_batch_axes(pairs.reach) * (turns * (turns + 2.0 * before))[None], axis=1)
    return EdgeBounds(jnp.sum(with_batch_axes(pairs.levers) * turns[None], axis=1), bend)


def displacements(pairs: Pairs, before: EdgeSample, after: EdgeSample) -> tuple[Array, Array]:
    """Returns how far C capsules and S bodies move from one configuration to another, in total and downward.

    A body moves at most as far as a corner of its bounding box.

    Args:
      pairs: the pairs of geoms that planning checks for contact.
      before: poses at the first configuration.
      after: poses at the second configuration.

    Returns:
      Distance that each capsule or body moves, f32[C + S] m: the largest one of the axis's two ends or of the box's
      eight corners. Distance that it moves downward, f32[C + S] m, 0 or more: also the largest one of these points.
    """
    center = primitives.subtract(after.axes.center, before.axes.center)
    half_axis = primitives.subtract(after.axes.half_axis, before.axes.half_axis)
    one = jnp.ones_like(center[0])
    moves = [primitives.add_scaled(center, sign * one, half_axis) for sign in (1.0, -1.0)]
    of_capsules = _largest_moves(moves)
    if not pairs.convex:
        return of_capsules
    of_bodies = _largest_moves(_corner_moves(pairs, before.frames, after.frames))
    return jnp.concatenate([of_capsules[0], of_bodies[0]]), jnp.concatenate([of_capsules[1], of_bodies[1]])


def _largest_moves(moves: list[Vector]) -> tuple[Array, Array]:
    """Returns the largest length in m of the moves of a solid's points, and the largest downward part."""
    distance = functools.reduce(jnp.maximum, [primitives.length(move) for move in moves])
    return distance, jnp.maximum(-functools.reduce(jnp.minimum, [move[2] for move in moves]), 0.0)


def _corner_moves(pairs: Pairs, before: Frames, after: Frames) -> list[Vector]:
    """Returns how the eight corners of the S bodies' bounding boxes move, Vectors of f32[S] m."""
    expand = functools.partial(append_axes, count=before.position[0].ndim - 1)
    center = jax.tree.map(expand, primitives.coordinates(pairs.bodies.box_center))
    size = jax.tree.map(expand, primitives.coordinates(pairs.bodies.box_size))
    offset = primitives.subtract(after.position, before.position)
    rows = [primitives.subtract(a, b) for a, b in zip(after.rotation, before.rotation, strict=True)]
    moves: list[Vector] = []
    for signs in itertools.product((-1.0, 1.0), repeat=3):
        x, y, z = (c + sign * half for c, sign, half in zip(center, signs, size, strict=True))
        turned = (dot(rows[0], (x, y, z)), dot(rows[1], (x, y, z)), dot(rows[2], (x, y, z)))
        moves.append(primitives.add_scaled(offset, jnp.ones_like(offset[0]), turned))
    return moves


def is_free_between(
    pairs: Pairs, ends: tuple[EdgeSample, EdgeSample], step: Array, bounds: EdgeBounds, distance: Array
) -> Array:
    """Returns bool[]: the two ends of a step prove that nothing touches between them.

    A step is a part of an edge (straight joint path).

    Args:
      pairs: the pairs of geoms that planning checks for contact.
      ends: distances and poses at the two ends of the step.
      step: f32[], length of the step as a share of the edge.
      bounds: upper bounds of the motion on the whole edge, from `edge_bounds`.
      distance: f32[C + S] m, how far each capsule or body moves from one end to the other; see `displacements`.
    """
    with_batch_axes = functools.partial(append_axes, count=step.ndim)
    gap, step = ends[0].gap + ends[1].gap, step[None]
    by_levers = gap >= bounds.rate * step + ROUNDING
    bend = (bounds.bend * step * step)[pairs.mover]
    by_chord = gap >= distance[pairs.mover] + 0.25 * bend + ROUNDING
    by_height = jnp.minimum(ends[0].gap, ends[1].gap) >= 0.125 * bend + ROUNDING
    by_position = jnp.where(with_batch_axes(pairs.part == collision.TABLE), by_height, by_chord)
    return jnp.all(by_levers | (with_batch_axes(pairs.is_still) & by_position), axis=0)
