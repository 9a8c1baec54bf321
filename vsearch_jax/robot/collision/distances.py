"""Signed distances of all pairs in `Pairs`.

The distance between a capsule's axis and another axis, a box or a cylinder takes a fixed number of operations. The
distance from an ellipsoid is convex along the axis; golden-section search finds its minimum.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from vsearch_jax.robot.collision import primitives
from vsearch_jax.robot.collision.pairs import Pairs, Solids
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

    If the axis of a capsule intersects a box or a cylinder, the distance is minus the capsule's radius. How deep the
    axis lies inside is not measured.

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
    return distances_from_axes(pairs, Axes(center, half_axis), table_height)


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


def distances_from_axes(pairs: Pairs, axes: Axes, table_height: Array) -> Array:
    """Computes the signed distances between the geoms of all collision pairs, from the axes of the capsules.

    `pair_distances` computes the same distances from the poses of the geoms.

    Args:
      pairs: the N pairs of geoms that must not touch.
      axes: axes of the capsules in world, from `capsule_axes`. A batch axis at the end is allowed.
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
    return jnp.concatenate(parts)


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
