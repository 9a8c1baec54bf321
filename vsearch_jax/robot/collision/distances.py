"""How far the solids of each pair are from one another.

From a capsule's axis to another, to a box or to a cylinder there are forms without a loop. From an ellipsoid the
distance is minimised over the axis; it is convex there, so a golden section finds it.
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
    """Axes of C capsules in world: their middles, Vector of f32[C] m, and from there to one end, Vector of f32[C] m."""

    center: Vector
    half_axis: Vector


def pair_distances(pairs: Pairs, geom_xpos: Array, geom_xmat: Array, table_height: Array) -> Array:
    """Returns the signed distance f32[N] in m of each pair, from the poses of the geoms.

    A capsule whose axis passes through a box or a cylinder is minus its radius away, however deep it is.

    Args:
      pairs: what must not touch.
      geom_xpos: f32[ngeom, 3] m in world.
      geom_xmat: f32[ngeom, 3, 3] to world.
      table_height: f32[] m, world z.
    """
    rotation = geom_xmat[pairs.geom]
    middle = primitives.rotate(rotation, primitives.coordinates(pairs.center))
    center = primitives.add_scaled(middle, jnp.ones_like(pairs.radius), primitives.coordinates(geom_xpos[pairs.geom]))
    return distances_from_axes(
        pairs, Axes(center, primitives.rotate(rotation, primitives.coordinates(pairs.half_axis))), table_height
    )


def capsule_axes(pairs: Pairs, rotations: Array, positions: Array) -> Axes:
    """Returns the axes of the capsules from the frames of the joints; see `kinematics.frames`, also for batches."""
    frame = pairs.placement.frame
    wide = functools.partial(append_axes, count=positions.ndim - 2)
    rotation = rotations[frame]
    center = positions[frame] + rotate_each(rotation, wide(pairs.placement.position))
    half_axis = rotate_each(rotation, wide(pairs.frame_half_axis))
    return Axes((center[:, 0], center[:, 1], center[:, 2]), (half_axis[:, 0], half_axis[:, 1], half_axis[:, 2]))


def distances_from_axes(pairs: Pairs, axes: Axes, table_height: Array) -> Array:
    """Returns what `pair_distances` does, from the axes of the capsules; these may have a batch axis more at the end."""
    center, half_axis = axes
    wide = functools.partial(append_axes, count=center[0].ndim - 1)
    radius = wide(pairs.radius)
    lowest = center[2] - jnp.abs(half_axis[2]) - radius
    first, second = pairs.first, pairs.second
    apart = primitives.segment_distance(*(_rows(v, i) for i in (first, second) for v in (center, half_axis)))
    solids = (pairs.boxes, pairs.cylinders, pairs.ellipsoids)
    sizes = [jax.tree.map(wide, primitives.coordinates(kind.size)) for kind in solids]
    local = [_in_frames(kind, axes, wide) for kind in solids]
    from_solids = (
        primitives.segment_box_distance(*local[0], sizes[0]),
        primitives.segment_cylinder_distance(*local[1], *sizes[1][:2]),
        primitives.least_along(lambda point: primitives.ellipsoid_distance(point, sizes[2]), *local[2]),
    )
    return jnp.concatenate(
        [
            lowest[pairs.table] - table_height,
            apart - radius[first] - radius[second],
            *(distance - radius[kind.capsule] for distance, kind in zip(from_solids, solids, strict=True)),
        ]
    )


def _in_frames(solids: Solids, axes: Axes, wide: Callable[[Array], Array]) -> Axes:
    """Returns the axes of the capsules in the frames of the solids."""
    columns = jax.tree.map(wide, [primitives.coordinates(solids.rotation[:, :, i]) for i in range(3)])
    offset = primitives.subtract(
        _rows(axes.center, solids.capsule), jax.tree.map(wide, primitives.coordinates(solids.position))
    )
    half_axis = _rows(axes.half_axis, solids.capsule)
    first, second, third = columns

    def turned(vector: Vector) -> Vector:
        return dot(first, vector), dot(second, vector), dot(third, vector)

    return Axes(turned(offset), turned(half_axis))


def min_distance(pairs: Pairs, gap: Array, part: int) -> Array:
    """Returns the least of the distances `gap` (f32[N]) from one part, f32[] m; +inf where there is nothing."""
    return jnp.min(jnp.where(pairs.part == part, gap, jnp.inf), initial=jnp.inf)


def _rows(vector: Vector, index: Array) -> Vector:
    return vector[0][index], vector[1][index], vector[2][index]
