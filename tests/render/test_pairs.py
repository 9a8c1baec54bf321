"""Strips of pixels around faces hold every pixel that a face covers, and not many others; the queue holds all pairs."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vsearch_jax.render.geometry import pairs

SIZE = 64


def strips_of(corners: np.ndarray) -> tuple[list[set[tuple[int, int]]], np.ndarray, np.ndarray]:
    """Returns the pixels (row, column) of each face's strip, the strips' pixel counts, and those of the rectangles.

    Args:
      corners: f64[T, 3, 2] pixels, column and row.
    """
    u, v = (list(jnp.asarray(corners[..., axis].T, jnp.float32)) for axis in (0, 1))
    low = np.clip(np.ceil(corners.min(axis=1) - 1e-3), 0, SIZE).astype(np.int32)
    stop = np.maximum(np.clip(np.floor(corners.max(axis=1) + 1e-3) + 1, 0, SIZE).astype(np.int32), low)
    columns, rows = (jnp.asarray(low[:, axis] | (stop[:, axis] << 16)) for axis in (0, 1))
    strips = pairs.narrow_strips(u, v, jnp.ones(len(corners), bool), columns, rows)
    count = np.asarray(pairs.count_pairs(strips))
    first = np.cumsum(count) - count
    face = np.repeat(np.arange(len(corners)), count)
    own = jax.tree.map(lambda x: x[face], strips)
    row, column, is_inside = pairs.pixels_of_pairs(own, jnp.arange(len(face)) - first[face])
    pixels: list[set[tuple[int, int]]] = [set() for _ in corners]
    for f, r, c, inside in zip(face, np.asarray(row), np.asarray(column), np.asarray(is_inside), strict=True):
        if inside:
            pixels[f].add((int(r), int(c)))
    return pixels, count, np.prod(stop - low, axis=1)


def covered_pixels(triangle: np.ndarray) -> set[tuple[int, int]]:
    """Returns the pixels (row, column) whose centres a triangle f64[3, 2] covers, from signs of areas in f64."""
    column, row = np.meshgrid(np.arange(SIZE, dtype=float), np.arange(SIZE, dtype=float))
    signs = []
    for i in range(3):
        (x, y), (other_x, other_y) = triangle[i], triangle[(i + 1) % 3]
        signs.append((other_x - x) * (row - y) - (other_y - y) * (column - x))
    is_inside = (np.min(signs, axis=0) >= 0.0) | (np.max(signs, axis=0) <= 0.0)
    return {(int(r), int(c)) for r, c in np.argwhere(is_inside)}


@pytest.mark.parametrize("kind", ["any", "long", "flat", "tiny", "integer"])
def test_a_strip_holds_every_pixel_that_its_face_covers(kind: str) -> None:
    rng = np.random.default_rng(3)
    corners = rng.uniform(-20.0, SIZE + 20.0, (300, 3, 2))
    if kind == "long":
        corners[:, 2] = corners[:, 0] + rng.normal(scale=1.5, size=(300, 2))
    elif kind == "flat":
        corners[..., 1] = corners[:, :1, 1] + rng.normal(scale=0.05, size=(300, 3))
    elif kind == "tiny":
        corners = corners[:, :1] + rng.normal(scale=1.0, size=(300, 3, 2))
    elif kind == "integer":  # corners and edges on pixel centres
        corners = np.round(corners)
    pixels, count, rectangle = strips_of(corners)
    total = 0
    for triangle, strip in zip(corners, pixels, strict=True):
        covered = covered_pixels(triangle)
        area = abs(np.linalg.det([triangle[1] - triangle[0], triangle[2] - triangle[0]]))
        if area > 1e-6:  # a face without area covers nothing
            assert covered <= strip
        total += len(covered)
    assert total > 0
    assert (count <= rectangle).all()
    if kind == "long":
        assert count.sum() < 0.35 * rectangle.sum()


@given(st.lists(st.sampled_from([0, 0, 1, 2, 63, 64, 65, 200]), min_size=1, max_size=80))
def test_the_queue_gives_each_pair_once_and_in_order(counts: list[int]) -> None:
    batch_size, zero = 64, jnp.int32(0)
    queue = jax.jit(pairs.make_queue, static_argnums=1)(jnp.array(counts), batch_size)
    take = jax.jit(pairs.next_pairs, static_argnums=2)
    position, faces, ranks = pairs.Position(zero, zero), [], []
    while position.entry < queue.length:
        face, rank, is_pair, position = take(queue, position, batch_size, zero)
        faces.extend(np.asarray(face)[np.asarray(is_pair)])
        ranks.extend(np.asarray(rank)[np.asarray(is_pair)])
        assert len(faces) == sum(counts) or len(faces) % batch_size == 0  # only the last batch is not full
    np.testing.assert_array_equal(faces, np.repeat(np.arange(len(counts)), counts))
    np.testing.assert_array_equal(ranks, [rank for count in counts for rank in range(count)])


def test_a_queue_may_hold_more_pairs_than_31_bits_count() -> None:
    huge, batch_size, zero = 2**30, 128, jnp.int32(0)
    queue = pairs.make_queue(jnp.array([huge, huge, huge, 5]), batch_size)
    position = pairs.Position(jnp.int32(1), jnp.int32(huge - 3))
    face, rank, is_pair, position = pairs.next_pairs(queue, position, batch_size, zero)
    np.testing.assert_array_equal(face, [1] * 3 + [2] * (batch_size - 3))
    np.testing.assert_array_equal(rank, [huge - 3, huge - 2, huge - 1, *range(batch_size - 3)])
    assert np.all(is_pair)
    assert (int(position.entry), int(position.rank)) == (2, batch_size - 3)
