"""Signed distances of all pairs in `Pairs`.

The distance between a capsule's axis and another axis, a box or a cylinder takes a fixed number of operations. The
distance from an ellipsoid is convex along the axis; golden-section search finds its minimum. Pairs with another solid
of the arm use GJK; see `robot.collision.convex`.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from vsearch_jax.robot.collision import primitives
from vsearch_jax.robot.collision.convex import Frames, convex_distances, lowest_points
from vsearch_jax.robot.collision.pairs import ConvexPairs, Pairs, Solids
from vsearch_jax.robot.kinematics import rotate_each
from vsearch_jax.xla.batching import append_axes
from vsearch_jax.xla.vectors import Vector, dot


class Axes(NamedTuple):
    """Axes of C capsules in world. A capsule's axis is the segment between the centres of its two end balls.

    Attributes:
      center: Vector (x, y and z) of f32[C] m, midpoints of the axes.
      half_axis: Vector of f32[C] m, vectors from the midpoint to one end.
    """

    center: Vector
    half_axis: Vector


def pair_distances(pairs: Pairs, geom_xpos: Array, geom_xmat: Array, table_height: Array) -> Array:
    """Computes the signed distances between the geoms of all collision pairs, from the poses of the geoms.

    The depth of a penetration is not measured, except between two capsules and with the table. If the axis of a capsule
    intersects a box or a cylinder, the distance is minus the capsule's radius.

    Args:
      pairs: the N pairs of geoms that must not touch.
      geom_xpos: f32[ngeom, 3] m in world, origins of the geoms.
      geom_xmat: f32[ngeom, 3, 3], rotations of the geoms, geom to world.
      table_height: f32[] m, world z of the table.

    Returns:
      Signed distance of each pair, f32[N] m; negative in contact.
    """
    rotation = geom_xmat[pairs.geom]
    offset = primitives.rotate(rotation, primitives.coordinates(pairs.center))
    center = primitives.add_scaled(offset, jnp.ones_like(pairs.radius), primitives.coordinates(geom_xpos[pairs.geom]))
    half_axis = primitives.rotate(rotation, primitives.coordinates(pairs.half_axis))
    frames = Frames(
        primitives.coordinates(geom_xpos[pairs.bodies.geom]), _rows_of_matrices(geom_xmat[pairs.bodies.geom])
    )
    return distances_from_poses(pairs, Axes(center, half_axis), frames, table_height)


def capsule_axes(pairs: Pairs, rotations: Array, positions: Array) -> Axes:
    """Computes the axes of all C capsules in world, from the frames of the joints.

    Args:
      pairs: the pairs of geoms that must not touch, and the C capsules of these pairs.
      rotations: f32[J + 1, 3, 3], frame to world, for the world and the J joints, from `robot.kinematics.frames`.
      positions: f32[J + 1, 3] m in world, origins of these frames. Both arrays may have a batch axis at the end.

    Returns:
      Axes of the C capsules in world; the batch axis, if any, is at the end.
    """
    frame = pairs.placement.frame
    expand = functools.partial(append_axes, count=positions.ndim - 2)
    rotation = rotations[frame]
    center = positions[frame] + rotate_each(rotation, expand(pairs.placement.position))
    half_axis = rotate_each(rotation, expand(pairs.frame_half_axis))
    return Axes((center[:, 0], center[:, 1], center[:, 2]), (half_axis[:, 0], half_axis[:, 1], half_axis[:, 2]))


def body_frames(pairs: Pairs, rotations: Array, positions: Array) -> Frames:
    """Computes the poses of the S bodies (`Pairs.bodies`) in world, from the frames of the joints.

    Args:
      pairs: the pairs of geoms that must not touch, and the S bodies of these pairs.
      rotations: f32[J + 1, 3, 3], frame to world, for the world and the J joints, from `robot.kinematics.frames`.
      positions: f32[J + 1, 3] m in world, origins of these frames. Both arrays may have a batch axis at the end.

    Returns:
      Poses of the S bodies in world; the batch axis, if any, is at the end.
    """
    placement = pairs.bodies.placement
    expand = functools.partial(append_axes, count=positions.ndim - 2)
    rotation = rotations[placement.frame]
    position = positions[placement.frame] + rotate_each(rotation, expand(placement.position))
    rotation = jnp.sum(rotation[:, :, :, None] * expand(placement.rotation)[:, None], axis=2)
    return Frames((position[:, 0], position[:, 1], position[:, 2]), _rows_of_matrices(rotation))


def _rows_of_matrices(matrices: Array) -> tuple[Vector, Vector, Vector]:
    """Splits f32[S, 3, 3, ...] into three rows of three arrays f32[S, ...]."""
    x, y, z = ((matrices[:, row, 0], matrices[:, row, 1], matrices[:, row, 2]) for row in range(3))
    return x, y, z


def distances_from_poses(pairs: Pairs, axes: Axes, frames: Frames, table_height: Array) -> Array:
    """Computes the signed distances between the geoms of all collision pairs, from the poses of capsules and bodies.

    `pair_distances` computes the same distances from the poses of the geoms.

    Args:
      pairs: the N pairs of geoms that must not touch.
      axes: axes of the capsules in world, from `capsule_axes`. A batch axis at the end is allowed.
      frames: poses of the bodies in world, from `body_frames`, with the same batch axis.
      table_height: f32[] m, world z of the table.

    Returns:
      Signed distance of each pair, f32[N] m, negative in contact; the batch axis, if any, is at the end.
    """
    center, half_axis = axes
    expand = functools.partial(append_axes, count=center[0].ndim - 1)
    radius = expand(pairs.radius)
    lowest = center[2] - jnp.abs(half_axis[2]) - radius
    first, second = pairs.first, pairs.second
    axis_distance = primitives.segment_distance(*(_rows(v, i) for i in (first, second) for v in (center, half_axis)))
    parts = [lowest[pairs.table] - table_height, axis_distance - radius[first] - radius[second]]
    solids = (
        (pairs.boxes, primitives.segment_box_distance),
        (pairs.cylinders, _segment_cylinder_distance),
        (pairs.ellipsoids, _segment_ellipsoid_distance),
    )
    for kind, distance in solids:
        if kind.capsule.size > 0:  # A kind without pairs would take as long to trace as any other.
            size = jax.tree.map(expand, primitives.coordinates(kind.size))
            parts.append(distance(*_axes_in_solid_frames(kind, axes, expand), size) - radius[kind.capsule])
    parts += [_convex_pair_distances(group, frames, table_height) for group in pairs.convex]
    return jnp.concatenate(parts)


def _convex_pair_distances(group: ConvexPairs, frames: Frames, table_height: Array) -> Array:
    first = _frame_rows(frames, group.first)
    if group.second_side is None:
        return lowest_points(group.first_side, first) - table_height
    return convex_distances(group.first_side, group.second_side, (first, _frame_rows(frames, group.second)))


def _frame_rows(frames: Frames, index: Array) -> Frames:
    x, y, z = (_rows(row, index) for row in frames.rotation)
    return Frames(_rows(frames.position, index), (x, y, z))


def _segment_cylinder_distance(center: Vector, half_axis: Vector, size: Vector) -> Array:
    return primitives.segment_cylinder_distance(center, half_axis, size[0], size[1])


def _segment_ellipsoid_distance(center: Vector, half_axis: Vector, size: Vector) -> Array:
    return primitives.min_along_segment(lambda point: primitives.ellipsoid_distance(point, size), center, half_axis)


def _axes_in_solid_frames(solids: Solids, axes: Axes, expand: Callable[[Array], Array]) -> Axes:
    """Returns the axis of each capsule in the frame of its solid. `expand` appends the batch axis."""
    columns = [primitives.coordinates(solids.rotation[:, :, i]) for i in range(3)]
    x_axis, y_axis, z_axis = jax.tree.map(expand, columns)
    center = _rows(axes.center, solids.capsule)
    offset = primitives.subtract(center, jax.tree.map(expand, primitives.coordinates(solids.position)))
    half_axis = _rows(axes.half_axis, solids.capsule)

    def to_solid_frame(vector: Vector) -> Vector:
        return dot(x_axis, vector), dot(y_axis, vector), dot(z_axis, vector)

    return Axes(to_solid_frame(offset), to_solid_frame(half_axis))


def min_distance(pairs: Pairs, gap: Array, part: int) -> Array:
    """Returns the arm's smallest distance f32[] in m from one part of the scene; +inf if no pair belongs to the part.

    Args:
      pairs: the N pairs of geoms that must not touch.
      gap: f32[N] m, signed distance of each pair, from `pair_distances`.
      part: TABLE, OBJECT, SELF (the arm itself and the mount) or OBSTACLE.
    """
    return jnp.min(jnp.where(pairs.part == part, gap, jnp.inf), initial=jnp.inf)


def _rows(vector: Vector, index: Array) -> Vector:
    """Returns the rows `index` of each coordinate."""
    return vector[0][index], vector[1][index], vector[2][index]
