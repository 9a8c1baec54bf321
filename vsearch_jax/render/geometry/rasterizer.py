"""Which triangle each pixel of a pinhole or parallel view sees: a rasteriser whose test is the exact one of a ray.

A face that is seen covers a pixel or two, so rays that look for faces would do far more work than faces that look for
pixels. Every face finds the rectangle of pixels around it; the pairs of face and pixel of all rectangles stand in one
long list, of which equal parts are tested at a time; the nearest face of each pixel stays. The cost is that of a few
simple passes over the faces plus that of the pairs, whose number the image bounds, not the mesh.
"""

from __future__ import annotations

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from vsearch_jax.render.geometry.triangles import Triangles
from vsearch_jax.xla.materialize import materialize
from vsearch_jax.xla.vectors import Vector

# A face that reaches closer to the viewer's plane, in m, is not projected; it is tested in all pixels.
_NEAR = 1e-6
# Rounding of a projected corner, far more than it is, in pixels.
_SLACK = 1e-3
# Pairs of face and pixel that are tested at a time.
_PART = 4096
# Less than 2^31 by what a sum in f32 may be off.
_MOST_PAIRS = 2.1e9


class Pinhole(NamedTuple):
    """How a view maps onto pixels: column = center_x + scale_x x, row = center_y - scale_y y.

    (x, y, -1) is a ray's direction in the view's frame; in a parallel view (x, y) m is where it starts. The centre of
    the first pixel has column and row 0.
    """

    scale_x: Array
    scale_y: Array
    center_x: Array
    center_y: Array


class Raster(NamedTuple):
    """The nearest face of each pixel.

    Attributes:
      depth: f32[H, W] m along the view's axis, +inf on a miss.
      face: i32[H, W]; 0 on a miss.
    """

    depth: Array
    face: Array


class View(NamedTuple):
    """Where the geoms are in a view that looks along -z, and how it maps onto pixels.

    Attributes:
      pose: f32[12, M], rows of the 3 x 4 matrix from the geom's frame to the view's.
      is_culled: f32[M], 1 where faces that show their back are passed over.
      pinhole: Pinhole.
      is_parallel: static.
    """

    pose: Array
    is_culled: Array
    pinhole: Pinhole
    is_parallel: bool


def _take(table: Array, index: Array) -> Array:
    return table.at[index].get(mode="promise_in_bounds")


def _per_face(table: Array, geom: Array) -> list[Array]:
    """Returns each row of `table` [R, M] looked up for each face's geom; a single geom's needs no looking up."""
    return [row[0] if table.shape[1] == 1 else _take(row, geom) for row in table]


def _corner(view: View, pose: list[Array], point: Vector) -> tuple[Array, Array, Array, Array]:
    """Returns homogeneous x, y, w and depth of a corner in the view's frame."""
    x, y, z = point
    rows = [pose[i] * x + pose[i + 1] * y + pose[i + 2] * z + pose[i + 3] for i in (0, 4, 8)]
    depth = -rows[2]
    return rows[0], rows[1], jnp.ones_like(depth) if view.is_parallel else depth, depth


def _least(values: list[Array]) -> Array:
    return jnp.minimum(jnp.minimum(values[0], values[1]), values[2])


def _most(values: list[Array]) -> Array:
    return jnp.maximum(jnp.maximum(values[0], values[1]), values[2])


def _extent(x: list[Array], w: list[Array], scale: Array, center: Array, count: int) -> Array:
    """Returns i32[T]: the first pixel that the face may cover along one axis, and above 16 bits the one after the last.

    Three corners before the viewer bound the face. Of a face with a corner behind, only those are sorted out that lie
    on the far side of an edge of the image, a test that holds for any corners.
    """
    pixel = [center + scale * a / jnp.where(b > _NEAR, b, 1.0) for a, b in zip(x, w, strict=True)]
    low_edge, high_edge = (-0.5 - center) / scale, (count - 0.5 - center) / scale
    is_outside = _most([a - low_edge * b for a, b in zip(x, w, strict=True)]) < 0.0
    is_outside |= _least([a - high_edge * b for a, b in zip(x, w, strict=True)]) > 0.0
    is_outside |= _most(w) <= _NEAR
    is_crossing = _least(w) <= _NEAR
    first = jnp.where(is_crossing, 0.0, jnp.clip(jnp.ceil(_least(pixel) - _SLACK), 0, count))
    stop = jnp.where(is_crossing, count, jnp.clip(jnp.floor(_most(pixel) + _SLACK) + 1.0, 0, count))
    stop = jnp.where(is_outside, first, jnp.maximum(first, stop))
    return first.astype(jnp.int32) | (stop.astype(jnp.int32) << 16)


def _is_front(x: list[Array], y: list[Array], w: list[Array]) -> Array:
    """Returns bool[T]: the corners run counterclockwise; true where one is behind the viewer."""
    inverse = [1.0 / jnp.where(b > _NEAR, b, 1.0) for b in w]
    u, v = ([a * b for a, b in zip(axis, inverse, strict=True)] for axis in (x, y))
    area = (u[1] - u[0]) * (v[2] - v[0]) - (u[2] - u[0]) * (v[1] - v[0])
    return (area > 0.0) | (_least(w) <= _NEAR)


def _rectangles(triangles: Triangles, view: View, size: tuple[int, int], zero: Array) -> tuple[Array, Array]:
    """Returns the columns and the rows of the pixels that each face may cover, as `_extent` does."""
    pose = _per_face(view.pose, triangles.geom)
    points = [(corner[0], corner[1], corner[2]) for corner in triangles.corners]
    x, y, w, _ = (list(values) for values in zip(*(_corner(view, pose, point) for point in points), strict=True))
    pinhole = view.pinhole
    columns = _extent(x, w, pinhole.scale_x, pinhole.center_x, size[1])
    rows = _extent([-a for a in y], w, pinhole.scale_y, pinhole.center_y, size[0])
    is_culled = _per_face(view.is_culled[None], triangles.geom)[0]
    rows = jnp.where((is_culled > 0.0) & ~_is_front(x, y, w), 0, rows)
    return materialize((columns, rows), zero)


def _running_maximum(values: Array) -> Array:
    """Returns i32[N], the largest value so far, all 0 or more, in two steps: XLA's own is slow on long arrays."""
    blocks = jax.lax.cummax(values.reshape(-1, 64), axis=1)
    last = jax.lax.cummax(blocks[:, -1])
    before = jnp.concatenate([jnp.zeros_like(last[:1]), last[:-1]])
    return jnp.maximum(blocks, before[:, None]).reshape(-1)


def _faces_of_pairs(begin: Array, end: Array, start: Array) -> Array:
    """Returns i32[_PART], the faces to which the pairs from `start` on belong."""
    num_faces = begin.shape[0]
    offset = begin - start
    # Faces without a pixel begin where the next one does, and give way to it.
    slot = jnp.where((offset >= 0) & (offset < _PART), offset, _PART)
    first = jnp.minimum(jnp.sum(end <= start), num_faces - 1).astype(jnp.int32)
    faces = jnp.full(_PART, first, jnp.int32).at[slot].max(jnp.arange(num_faces, dtype=jnp.int32), mode="drop")
    return faces


def _depth_at(triangles: Triangles, view: View, face: Array, pixel: tuple[Array, Array], zero: Array) -> Array:
    """Returns f32[N] m, where the rays of `pixel` (column, row) meet `face`, +inf where they do not.

    Corners are sheared so that the ray is the axis; then the areas that it cuts off are precise even of the smallest
    face, and the same for both faces of an edge (Woop et al., Watertight ray/triangle intersection, 2013).
    """
    pinhole = view.pinhole
    ray_x = (pixel[0] - pinhole.center_x) / pinhole.scale_x
    ray_y = (pinhole.center_y - pixel[1]) / pinhole.scale_y
    table = triangles.corners.reshape(9, -1)
    axes = materialize([_take(row, face) for row in table], zero)
    geom = face if view.pose.shape[1] == 1 else materialize(_take(triangles.geom, face), zero)
    pose = _per_face(view.pose, geom)
    x, y, depth = [], [], []
    for i in (0, 3, 6):
        corner_x, corner_y, w, corner_depth = _corner(view, pose, (axes[i], axes[i + 1], axes[i + 2]))
        x.append(corner_x - ray_x * w)
        y.append(corner_y - ray_y * w)
        depth.append(corner_depth)
    areas = [x[1] * y[2] - x[2] * y[1], x[2] * y[0] - x[0] * y[2], x[0] * y[1] - x[1] * y[0]]
    whole = areas[0] + areas[1] + areas[2]
    met = (areas[0] * depth[0] + areas[1] * depth[1] + areas[2] * depth[2]) / jnp.where(whole == 0.0, 1.0, whole)
    is_met = ((_least(areas) >= 0.0) | (_most(areas) <= 0.0)) & (whole != 0.0)
    return jnp.where(is_met & (view.is_parallel | (met > 0.0)), met, jnp.inf)  # pyright: ignore[reportReturnType] # an array


class _Pairs(NamedTuple):
    columns: Array
    rows: Array
    begin: Array
    end: Array


def _is_left(pairs: _Pairs, state: tuple[Array, Array, Array]) -> Array:
    return state[0] < pairs.end[-1]


def _test_part(
    triangles: Triangles,
    view: View,
    pairs: _Pairs,
    context: tuple[tuple[int, int], Array],
    state: tuple[Array, Array, Array],
) -> tuple[Array, Array, Array]:
    (height, width), zero = context
    start, best, faces = state
    num_pixels = height * width
    face = _running_maximum(materialize(_faces_of_pairs(pairs.begin, pairs.end, start), zero))
    face = materialize(face, zero)
    columns, rows, begin = materialize([_take(t, face) for t in (pairs.columns, pairs.rows, pairs.begin)], zero)
    number = start + jnp.arange(_PART, dtype=jnp.int32)
    first_column, first_row = columns & 0xFFFF, rows & 0xFFFF
    box_width = jnp.maximum((columns >> 16) - first_column, 1)
    rank = number - begin
    # A division of floats, as that of integers is not vectorised; its rounding is mended.
    row = jnp.floor((rank.astype(jnp.float32) + 0.5) / box_width.astype(jnp.float32)).astype(jnp.int32)
    row = row + jnp.where(rank < row * box_width, -1, jnp.where(rank >= (row + 1) * box_width, 1, 0))
    row, column = materialize((first_row + row, first_column + rank - row * box_width), zero)
    pixel = (column.astype(jnp.float32), row.astype(jnp.float32))
    depth = materialize(_depth_at(triangles, view, face, pixel, zero), zero)
    is_met = (number < pairs.end[-1]) & (depth < jnp.inf)
    target = materialize(jnp.where(is_met, row * width + column, num_pixels), zero)
    best = best.at[target].min(depth, mode="drop")
    is_best = depth <= _take(best, jnp.minimum(target, num_pixels - 1))
    faces = faces.at[jnp.where(is_best, target, num_pixels)].set(face, mode="drop")
    return start + _PART, best, faces


def rasterize(triangles: Triangles, view: View, size: tuple[int, int], zero: Array) -> Raster:
    """Returns the nearest face of each pixel.

    Args:
      triangles: Triangles.
      view: View.
      size: height and width in pixels, each at most 32,767, static.
      zero: see `boundary.materialize`.

    Returns:
      Raster, its depth NaN where there are more pairs of face and pixel than 31 bits can count.
    """
    columns, rows = _rectangles(triangles, view, size, zero)
    count = ((columns >> 16) - (columns & 0xFFFF)) * ((rows >> 16) - (rows & 0xFFFF))
    end = materialize(jnp.cumsum(count), zero)
    pairs = _Pairs(columns, rows, materialize(end - count, zero), end)
    num_pixels = size[0] * size[1]
    initial = (jnp.zeros_like(zero), jnp.full(num_pixels, jnp.inf, jnp.float32), jnp.zeros(num_pixels, jnp.int32))
    step = functools.partial(_test_part, triangles, view, pairs, (size, zero))
    _, depth, face = jax.lax.while_loop(functools.partial(_is_left, pairs), step, initial)
    depth = jnp.where(jnp.sum(count.astype(jnp.float32)) < _MOST_PAIRS, depth, jnp.nan)
    return Raster(depth.reshape(size), face.reshape(size))
