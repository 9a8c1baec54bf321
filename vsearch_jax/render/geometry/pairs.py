"""Numbers for all pairs (face, pixel of the face's strip), and the way back from a number to its pair.

Face 0 owns the first numbers, face 1 the next ones, and so on. Within a face, pixels are counted row by row. Each row
of a strip has the same number of pixels, and begins at the left edge of the face. So the strip of a long, slanted face
is narrow, although the rectangle around the face is large.
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


class Pairs(NamedTuple):
    """The strips of T faces, and the numbers of the face's pairs (face, pixel of its strip).

    Attributes:
      strips: Strips.
      first: i32[T], number of the face's first pair.
      stop: i32[T], number of the face's last pair plus 1.
    """

    strips: Strips
    first: Array
    stop: Array


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


def faces_of_pairs(pairs: Pairs, start: Array, batch_size: int, zero: Array) -> Array:
    """Returns the face of each pair (face, pixel of its strip) in a batch of pairs with consecutive numbers.

    Args:
      pairs: strip of each face, and numbers of the pairs of each face.
      start: i32[], number of the first pair of the batch.
      batch_size: number of pairs B in the batch, a multiple of 64; static.
      zero: i32[], a 0 that the compiler does not know to be 0. It keeps XLA from computing results twice.

    Returns:
      Number of each pair's face, i32[B]. A number after the last pair gets the last face that begins before it.
    """
    marks = materialize(_mark_first_pairs(pairs, start, batch_size), zero)
    return materialize(_running_maximum(marks), zero)


def _mark_first_pairs(pairs: Pairs, start: Array, batch_size: int) -> Array:
    """Returns i32[B]: at the first pair of each face that face, and elsewhere the face of pair number `start`."""
    num_faces = pairs.first.shape[0]
    offset = pairs.first - start
    # A face without pairs has the same first number as the next face. The maximum keeps the next face.
    slot = jnp.where((offset >= 0) & (offset < batch_size), offset, batch_size)
    face_at_start = jnp.minimum(jnp.sum(pairs.stop <= start), num_faces - 1).astype(jnp.int32)
    marks = jnp.full(batch_size, face_at_start, jnp.int32)
    return marks.at[slot].max(jnp.arange(num_faces, dtype=jnp.int32), mode="drop")


def _running_maximum(values: Array) -> Array:
    """Returns i32[B], the largest of `values` (i32[B], at least 0) up to each position."""
    # First within blocks of 64, then over the blocks: XLA's own running maximum is slow on long arrays.
    blocks = jax.lax.cummax(values.reshape(-1, 64), axis=1)
    last = jax.lax.cummax(blocks[:, -1])
    before = jnp.concatenate([jnp.zeros_like(last[:1]), last[:-1]])
    return jnp.maximum(blocks, before[:, None]).reshape(-1)


def pixels_of_pairs(strips: Strips, first: Array, number: Array) -> tuple[Array, Array, Array]:
    """Returns the pixel of each of B pairs (face, pixel of its strip).

    Args:
      strips: the strip of each pair's face, arrays of B.
      first: i32[B], number of the first pair of that face.
      number: i32[B], number of the pair.

    Returns:
      Row i32[B] and column i32[B] of the pixel; and bool[B], whether the pixel lies in the face's rectangle.
    """
    first_column, first_row = strips.columns & 0xFFFF, strips.rows & 0xFFFF
    width = jnp.maximum(strips.width, 1)
    rank = number - first
    # XLA vectorises the division of floats, but not that of integers. The second line corrects the rounding.
    row = jnp.floor((rank.astype(jnp.float32) + 0.5) / width.astype(jnp.float32)).astype(jnp.int32)
    row = row + jnp.where(rank < row * width, -1, jnp.where(rank >= (row + 1) * width, 1, 0))
    height = (first_row + row).astype(jnp.float32)
    edges = [a + b * height for a, b in zip(strips.intercepts, strips.slopes, strict=True)]
    left = jnp.ceil(jnp.maximum(first_column.astype(jnp.float32), jnp.maximum(*edges)))
    stop = strips.columns >> 16
    column = jnp.minimum(left, stop.astype(jnp.float32)).astype(jnp.int32) + rank - row * width
    return first_row + row, column, column < stop
