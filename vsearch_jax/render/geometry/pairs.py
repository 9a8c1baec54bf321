"""A queue of all pairs (face, pixel of the face's strip), from which a loop takes a fixed number of pairs at a time.

The pairs of the first face come first, then those of the second one, and so on. Within a face, pixels are counted row
by row. Each row of a strip has the same number of pixels, and begins at the left edge of the face. So the strip of a
long, slanted face is narrow, although the rectangle around the face is large.

No number counts the pairs of all faces together, so their number has no limit.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from vsearch_jax.xla.materialize import materialize

# Pixels. Strips grow by this, times 1 + the slope of an edge. A corner further away than _MAX_COORDINATE is not exact
# enough, and a face less high than _MIN_HEIGHT has no slope. The strip of such a face is its rectangle.
_EDGE_MARGIN, _MAX_COORDINATE, _MIN_HEIGHT = 1e-2, 4096.0, 1e-3
# Intercept of a line that is left of every pixel.
_FAR_LEFT = -1e9


class Strips(NamedTuple):
    """The pixels that may show each of T faces: in every row of a rectangle, `width` pixels from a left edge on.

    The left edge in row r is the larger of intercept + slope * r of two lines, and lies in the rectangle. An interval
    of pixels is one i32: the low 16 bits hold the first pixel, the high 16 bits the last pixel plus 1.

    Attributes:
      columns: i32[T], interval of the rectangle's columns.
      rows: i32[T], interval of the rectangle's rows.
      width: i32[T], number of pixels of each row; at least 1 where the rectangle holds a pixel.
      intercepts: f32[T] pixels for each of the two lines.
      slopes: f32[T] for each of the two lines.
    """

    columns: Array
    rows: Array
    width: Array
    intercepts: tuple[Array, Array]
    slopes: tuple[Array, Array]


class Queue(NamedTuple):
    """The faces that have pairs, in ascending order. E is the number of all faces plus the size of a batch.

    Attributes:
      face: i32[E], number of the face of each entry; meaningless from entry `length` on.
      num_pairs: i32[E], number of pairs of the face; 0 from entry `length` on.
      length: i32[], number of entries.
    """

    face: Array
    num_pairs: Array
    length: Array


class Position(NamedTuple):
    """A place in the queue: the next pair is pair number `rank` of the face of entry `entry`.

    Attributes:
      entry: i32[].
      rank: i32[].
    """

    entry: Array
    rank: Array


# Elementwise, and not `jnp.min` of a stack: XLA on CPU is slow on an axis of length 3.
def min_of_three(values: list[Array]) -> Array:
    """Returns the elementwise minimum of three arrays."""
    return jnp.minimum(jnp.minimum(values[0], values[1]), values[2])


def max_of_three(values: list[Array]) -> Array:
    """Returns the elementwise maximum of three arrays."""
    return jnp.maximum(jnp.maximum(values[0], values[1]), values[2])


def narrow_strips(u: list[Array], v: list[Array], is_in_front: Array, columns: Array, rows: Array) -> Strips:
    """Computes strips along the left edges of T faces.

    Args:
      u: f32[T] pixels for each of three corners, column.
      v: f32[T] pixels for each of three corners, row.
      is_in_front: bool[T], all corners are in front of the viewer.
      columns: i32[T], columns of the rectangle that holds each face.
      rows: i32[T], rows of that rectangle.

    Returns:
      For each face a strip that holds all pixels of the rectangle whose centres the face covers.
    """
    height = max_of_three(v) - min_of_three(v)
    largest = jnp.maximum(*(max_of_three([jnp.abs(a) for a in axis]) for axis in (u, v)))
    is_exact = is_in_front & (largest < _MAX_COORDINATE) & (height > _MIN_HEIGHT)
    lines: list[tuple[Array, Array, Array]] = []
    face_width, left_margin, right_margin = (jnp.zeros_like(height) for _ in range(3))
    for i, j, opposite in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        rise = v[j] - v[i]
        is_edge = jnp.abs(rise) > 1e-6
        slope = jnp.where(is_edge, (u[j] - u[i]) / jnp.where(is_edge, rise, 1.0), 0.0)
        intercept = u[i] - slope * v[i]
        distance = u[opposite] - (intercept + slope * v[opposite])
        margin = jnp.where(is_edge, _EDGE_MARGIN * (1.0 + jnp.abs(slope)), 0.0)
        is_left = is_edge & (distance > 0.0)
        # A face is widest in the row of its middle corner. There, the opposite edge is the long one.
        is_middle = (v[opposite] - v[i]) * (v[opposite] - v[j]) <= 0.0
        face_width = jnp.maximum(face_width, jnp.where(is_middle & is_edge, jnp.abs(distance), 0.0))
        left_margin = jnp.maximum(left_margin, jnp.where(is_left, margin, 0.0))
        right_margin = jnp.maximum(right_margin, jnp.where(is_left, 0.0, margin))
        is_used = is_left & is_exact
        lines.append((is_used, jnp.where(is_used, intercept - margin, _FAR_LEFT), jnp.where(is_used, slope, 0.0)))
    # At most two of the three edges are on the left: the first and the last of them.
    (is_first, *first), (is_second, *second), (is_third, *third) = lines
    one = [jnp.where(is_first, a, jnp.where(is_second, b, c)) for a, b, c in zip(first, second, third, strict=True)]
    two = [jnp.where(is_third, c, jnp.where(is_second, b, a)) for a, b, c in zip(first, second, third, strict=True)]
    full = (columns >> 16) - (columns & 0xFFFF)
    widest = jnp.floor(jnp.minimum(face_width + left_margin + right_margin + _EDGE_MARGIN, 1e6)).astype(jnp.int32) + 1
    width = jnp.where(is_exact, jnp.minimum(widest, full), full)
    return Strips(columns, rows, width, (one[0], two[0]), (one[1], two[1]))


def count_pairs(strips: Strips) -> Array:
    """Returns the number of pixels in the strip of each of T faces, i32[T]."""
    return strips.width * ((strips.rows >> 16) - (strips.rows & 0xFFFF))


def make_queue(count: Array, batch_size: int) -> Queue:
    """Returns the queue of all pairs (face, pixel of its strip).

    Args:
      count: i32[T], number of pairs of each face; see `count_pairs`.
      batch_size: number of pairs that `next_pairs` takes at a time, static.
    """
    num_faces = count.shape[0]
    has_pairs = count > 0
    entry = jnp.cumsum(has_pairs, dtype=jnp.int32) - 1
    slot = jnp.where(has_pairs, entry, num_faces + batch_size)
    empty = jnp.zeros(num_faces + batch_size, jnp.int32)
    face = empty.at[slot].set(jnp.arange(num_faces, dtype=jnp.int32), mode="drop")
    return Queue(face, empty.at[slot].set(count, mode="drop"), entry[-1] + 1)


def next_pairs(queue: Queue, position: Position, batch_size: int, zero: Array) -> tuple[Array, Array, Array, Position]:
    """Takes the next B pairs (face, pixel of its strip) from the queue.

    Args:
      queue: the queue, made for batches of B pairs.
      position: where the batch begins.
      batch_size: number of pairs B in the batch, a multiple of 64 and at most 2^22; static.
      zero: i32[], a 0 that the compiler does not know to be 0. It keeps XLA from computing results twice.

    Returns:
      Face of each pair, i32[B]. Number of the pair within its face, i32[B]. Whether there is a pair, bool[B]: after the
      end of the queue there is none. Position of the next batch.
    """
    # Each entry has a pair, so the next B entries hold the next B pairs.
    face, count = (jax.lax.dynamic_slice(x, (position.entry,), (batch_size,)) for x in (queue.face, queue.num_pairs))
    left = jnp.minimum(count.at[0].add(-position.rank), batch_size + 1)
    # The sum in f32 cannot overflow, and is exact up to 2^24. What lies beyond B only has to be larger than B.
    total = jnp.minimum(materialize(_running_sum(left.astype(jnp.float32)), zero), 2.0 * batch_size + 1.0)
    stop = total.astype(jnp.int32)
    first = (stop - left).at[0].set(-position.rank)
    slot = jnp.where((left > 0) & (stop - left < batch_size), stop - left, batch_size)
    index = jnp.arange(batch_size, dtype=jnp.int32)
    marks = materialize(jnp.zeros(batch_size, jnp.int32).at[slot].max(index, mode="drop"), zero)
    entry = materialize(_running_maximum(marks), zero)
    face, first_of_face = (x.at[entry].get(mode="promise_in_bounds") for x in (face, first))
    num_done = jnp.sum(stop <= batch_size, dtype=jnp.int32)
    # The face after the last one that is done has given some pairs, or none.
    rank = batch_size - first[jnp.minimum(num_done, batch_size - 1)]
    new = Position(position.entry + num_done, jnp.where(num_done < batch_size, rank, 0))
    return face, index - first_of_face, index < stop[-1], new


def _running_sum(values: Array) -> Array:
    """Returns f32[B], the sum of `values` (f32[B]) up to each position."""
    # First within blocks of 64, then over the blocks: XLA's own running sum is slow on long arrays.
    blocks = jnp.cumsum(values.reshape(-1, 64), axis=1)
    last = jnp.cumsum(blocks[:, -1])
    return (blocks + (last - blocks[:, -1])[:, None]).reshape(-1)


def _running_maximum(values: Array) -> Array:
    """Returns i32[B], the largest of `values` (i32[B], at least 0) up to each position."""
    # First within blocks of 64, then over the blocks: XLA's own running maximum is slow on long arrays.
    blocks = jax.lax.cummax(values.reshape(-1, 64), axis=1)
    last = jax.lax.cummax(blocks[:, -1])
    before = jnp.concatenate([jnp.zeros_like(last[:1]), last[:-1]])
    return jnp.maximum(blocks, before[:, None]).reshape(-1)


def pixels_of_pairs(strips: Strips, rank: Array) -> tuple[Array, Array, Array]:
    """Returns the pixel of each of B pairs (face, pixel of its strip).

    Args:
      strips: the strip of each pair's face, arrays of B.
      rank: i32[B], number of the pair within its face.

    Returns:
      Row i32[B] and column i32[B] of the pixel; and bool[B], whether the pixel lies in the face's rectangle.
    """
    first_column, first_row = strips.columns & 0xFFFF, strips.rows & 0xFFFF
    width = jnp.maximum(strips.width, 1)
    # XLA vectorises the division of floats, but not that of integers. The second line corrects the rounding.
    row = jnp.floor((rank.astype(jnp.float32) + 0.5) / width.astype(jnp.float32)).astype(jnp.int32)
    row = row + jnp.where(rank < row * width, -1, jnp.where(rank >= (row + 1) * width, 1, 0))
    height = (first_row + row).astype(jnp.float32)
    edges = [a + b * height for a, b in zip(strips.intercepts, strips.slopes, strict=True)]
    left = jnp.ceil(jnp.maximum(first_column.astype(jnp.float32), jnp.maximum(*edges)))
    stop = strips.columns >> 16
    column = jnp.minimum(left, stop.astype(jnp.float32)).astype(jnp.int32) + rank - row * width
    return first_row + row, column, column < stop
