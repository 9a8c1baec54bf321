"""Support functions of convex solids: the farthest point along a direction.

A Vector is a tuple of three arrays (`xla.vectors.Vector`). Arrays have one column for each pair of solids, written
f32[P, ...] here; a batch axis may follow.
"""

from __future__ import annotations

import functools
from collections.abc import Callable

import flax.struct
import jax
import jax.numpy as jnp
from jax import Array

from vsearch_jax.robot.collision.primitives import add_scaled, length
from vsearch_jax.xla.batching import append_axes
from vsearch_jax.xla.vectors import Vector, dot

# Vertices that one step of a loop compares. They are unrolled, so that XLA keeps the intermediate values in registers.
BLOCK = 16


@flax.struct.dataclass
class Side:
    """The first or the second solids of P pairs, each in the frame of its geom.

    Attributes:
      points: f32[K, 3, P] m, points whose convex hulls are the cores of the solids. The last ones may be repeated.
      coarse: f32[L, 3, P] m, a few of these points; None if `points` are few.
      center: f32[3, P] m, a point inside each solid.
      bound: f32[P] m, largest distance of the points from the origin of the frame.
      radii: f32[3, P] m, radii of the ellipsoids that are added to the cores; None if no solid has one.
      ball: f32[P] m, radii of the balls that are added.
    """

    points: Array
    coarse: Array | None
    center: Array
    bound: Array
    radii: Array | None
    ball: Array


def _vertices(side: Side, is_coarse: bool) -> Array:
    return side.coarse if is_coarse and side.coarse is not None else side.points


def _fold_vertices(vertices: Array, direction: Vector, init: Array, fold: Callable[..., Array]) -> Array:
    """Folds `fold(result, number, height)` over the vertices f32[K, 3, P].

    `number` is the vertex's number, `height` its place along `direction`.
    """
    count, expand = vertices.shape[0], functools.partial(append_axes, count=direction[0].ndim - 1)

    def fold_block(block: Array, first: Array | int, result: Array) -> Array:
        for i in range(block.shape[0]):
            point = (expand(block[i, 0]), expand(block[i, 1]), expand(block[i, 2]))
            result = fold(result, first + i, dot(point, direction))
        return result

    if count <= BLOCK:
        return fold_block(vertices, 0, init)

    def step(result: Array, item: tuple[Array, Array]) -> tuple[Array, None]:
        return fold_block(item[0], item[1], result), None

    blocks = vertices.reshape(-1, BLOCK, *vertices.shape[1:])
    return jax.lax.scan(step, init, (blocks, jnp.arange(blocks.shape[0], dtype=jnp.int32) * BLOCK))[0]


def extent(side: Side, direction: Vector) -> Array:
    """Computes how far solids without their balls reach along a direction, from the origins of their frames.

    Args:
      side: the solids of P pairs.
      direction: Vector of f32[P, ...], unit vectors in the frames of the solids.

    Returns:
      f32[P, ...] m.
    """
    init = jnp.full_like(direction[0], -jnp.inf)
    core = _fold_vertices(side.points, direction, init, lambda result, _, height: jnp.maximum(result, height))
    if side.radii is None:
        return core
    return core + length(_scaled_by_radii(side.radii, direction))


def farthest_vertex(side: Side, is_coarse: bool, direction: Vector) -> Array:
    """Finds the vertex of each solid that is farthest along a direction; one of the farthest if they nearly tie.

    A vertex's number is kept in the low bits of its height, so that one maximum finds both.

    Args:
      side: the solids of P pairs.
      is_coarse: whether to search the coarse hulls only, where there are some.
      direction: Vector of f32[P, ...], unit vectors in the frames of the solids.

    Returns:
      i32[P, ...], numbers of the vertices.
    """
    vertices = _vertices(side, is_coarse)
    mask = (1 << (vertices.shape[0] - 1).bit_length()) - 1
    bound = append_axes(side.bound, direction[0].ndim - 1)

    def fold(result: Array, number: Array | int, height: Array) -> Array:
        # Integers order as positive floats do.
        bits = jax.lax.bitcast_convert_type(height + bound, jnp.int32)
        return jnp.maximum(result, (bits & ~mask) | number)

    return _fold_vertices(vertices, direction, jnp.zeros(direction[0].shape, jnp.int32), fold) & mask


def support_point(side: Side, is_coarse: bool, number: Array, direction: Vector) -> Vector:
    """Returns the points of solids without their balls that are farthest along a direction.

    Args:
      side: the solids of P pairs.
      is_coarse: as for `farthest_vertex`.
      number: i32[P, ...], the farthest vertices, from `farthest_vertex`.
      direction: Vector of f32[P, ...], unit vectors in the frames of the solids.

    Returns:
      The points, Vector of f32[P, ...] m in the frames of the solids.
    """
    vertices = _vertices(side, is_coarse)
    if vertices.shape[0] <= BLOCK:
        x, y, z = (_select_row(vertices[:, axis], number) for axis in range(3))
    else:
        pair = append_axes(jnp.arange(vertices.shape[2], dtype=jnp.int32), number.ndim - 1)
        x, y, z = (vertices.at[number, axis, pair].get(mode="promise_in_bounds") for axis in range(3))
    point = (x, y, z)
    if side.radii is None:
        return point
    scaled = _scaled_by_radii(side.radii, direction)
    inverse = 1.0 / length(scaled)
    twice = _scaled_by_radii(side.radii, scaled)
    return add_scaled(point, inverse, twice)


def _select_row(table: Array, number: Array) -> Array:
    """Returns f32[P, ...], row `number` of f32[K, P] in each column. Selects are faster than a gather for few rows."""
    expand = functools.partial(append_axes, count=number.ndim - 1)
    result = jnp.broadcast_to(expand(table[0]), number.shape)
    for row in range(1, table.shape[0]):
        result = jnp.where(number == row, expand(table[row]), result)
    return result


def _scaled_by_radii(radii: Array, vector: Vector) -> Vector:
    expand = functools.partial(append_axes, count=vector[0].ndim - 1)
    return expand(radii[0]) * vector[0], expand(radii[1]) * vector[1], expand(radii[2]) * vector[2]
