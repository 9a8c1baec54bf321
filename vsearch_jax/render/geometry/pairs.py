"""Numbers for all pairs (face, pixel of the face's rectangle), and the way back from a number to its pair.

Face 0 owns the first numbers, face 1 the next ones, and so on. Within a face, pixels are counted row by row.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from vsearch_jax.xla.materialize import materialize


class Pairs(NamedTuple):
    """The pixel rectangle around each of T faces, and the numbers of the face's pairs (face, pixel of its rectangle).

    An interval of pixels is one i32: the low 16 bits hold the first pixel, the high 16 bits the last pixel plus 1.

    Attributes:
      columns: i32[T], interval of the rectangle's columns.
      rows: i32[T], interval of the rectangle's rows.
      first: i32[T], number of the face's first pair.
      stop: i32[T], number of the face's last pair plus 1.
    """

    columns: Array
    rows: Array
    first: Array
    stop: Array


def count_pairs(columns: Array, rows: Array) -> Array:
    """Returns the number of pixels in the rectangle of each of T faces, i32[T].

    Args:
      columns: i32[T], columns of each rectangle: first column in the low 16 bits, last column plus 1 in the high 16.
      rows: i32[T], rows of each rectangle, in the same form.
    """
    return ((columns >> 16) - (columns & 0xFFFF)) * ((rows >> 16) - (rows & 0xFFFF))


def faces_of_pairs(pairs: Pairs, start: Array, batch_size: int, zero: Array) -> Array:
    """Returns the face of each pair (face, pixel of its rectangle) in a batch of pairs with consecutive numbers.

    Args:
      pairs: pixel rectangle of each face, and numbers of the pairs of each face.
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


def pixels_of_pairs(columns: Array, rows: Array, first: Array, number: Array) -> tuple[Array, Array]:
    """Returns the image row and column of the pixel of each of B pairs (face, pixel of its rectangle), i32[B] each.

    Args:
      columns: i32[B], columns of the rectangle of each pair's face: first column in the low 16 bits, last column plus 1
        in the high 16 bits.
      rows: i32[B], rows of that rectangle, in the same form.
      first: i32[B], number of the first pair of that face.
      number: i32[B], number of the pair.
    """
    first_column, first_row = columns & 0xFFFF, rows & 0xFFFF
    width = jnp.maximum((columns >> 16) - first_column, 1)
    rank = number - first
    # XLA vectorises the division of floats, but not that of integers. The second line corrects the rounding.
    row = jnp.floor((rank.astype(jnp.float32) + 0.5) / width.astype(jnp.float32)).astype(jnp.int32)
    row = row + jnp.where(rank < row * width, -1, jnp.where(rank >= (row + 1) * width, 1, 0))
    return first_row + row, first_column + rank - row * width
