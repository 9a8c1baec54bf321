"""A rasteriser for triangles: the nearest face of each pixel, with an exact ray–triangle test.

A visible face of a mesh covers only a few pixels. So it is cheaper to find the pixels of each face than to find the
face of each ray. The algorithm has three steps:

1. `_bounding_strips` projects the corners of every face, and returns a strip of pixels that holds the face. The strip
   of a long, slanted face is narrow; CAD programs make many such faces. Faces outside the image and culled faces get an
   empty strip.
2. All pairs (face, pixel of its strip) are numbered; see `render.geometry.pairs`. A loop takes a batch of consecutive
   numbers at a time, and recovers from each number the face (a scatter of the faces' first numbers, then a running
   maximum) and the pixel (the pair's rank within its face).
3. For each pair, the ray through the pixel's centre is tested against the face. The nearest hit of each pixel is kept
   (a depth buffer, by a scatter of minima).

The test is that of Woop, Benthin and Wald, "Watertight Ray/Triangle Intersection", JCGT 2(1), 2013: the corners are
sheared so that the ray becomes the z axis, then the signs of three areas tell on which side of each edge the ray is.
Two faces that share an edge compute the area of that edge from the same numbers, so no ray slips between them.

Step 1 costs a few passes over the faces. Steps 2 and 3 cost as much as there are pairs, and that number depends on the
image more than on the number of faces.
"""

from __future__ import annotations

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from vsearch_jax.render.geometry.pairs import (
    Pairs,
    Strips,
    count_pairs,
    faces_of_pairs,
    max_of_three,
    min_of_three,
    narrow_strips,
    pixels_of_pairs,
)
from vsearch_jax.render.geometry.triangles import Triangles
from vsearch_jax.xla.materialize import materialize
from vsearch_jax.xla.vectors import Vector

# m. A face that comes closer than this to the plane of the viewer is not projected; it is tested in all pixels.
_NEAR = 1e-6
# Pixels. Rectangles grow by this, which is far more than the rounding error of a projected corner.
_MARGIN = 1e-3
# Pairs (face, pixel) that are tested at a time.
_BATCH = 4096
# Largest number of pairs. It is below 2^31 by more than the rounding error of the sum in f32 that counts them.
_MAX_PAIRS = 2.1e9


class Pinhole(NamedTuple):
    """How a view maps onto pixels: column = center_x + scale_x * x, row = center_y - scale_y * y.

    In a perspective view, (x, y, -1) is the direction of a ray in the view's frame. In a parallel view, (x, y) m is the
    origin of a ray. The centre of the first pixel has column 0 and row 0.

    Attributes:
      scale_x: f32[] pixels; pixels per m in a parallel view.
      scale_y: f32[] pixels; pixels per m in a parallel view.
      center_x: f32[] pixels, column of the view's axis.
      center_y: f32[] pixels, row of the view's axis.
    """

    scale_x: Array
    scale_y: Array
    center_x: Array
    center_y: Array


class Raster(NamedTuple):
    """The nearest triangle (face) in each of H x W pixels.

    Attributes:
      depth: f32[H, W] m along the view's axis, +inf on a miss.
      face: i32[H, W], row of the face in `Triangles`; 0 on a miss.
    """

    depth: Array
    face: Array


class Projection(NamedTuple):
    """How M geoms are drawn: the poses of the geoms in a view's frame, and the mapping from this frame to pixels.

    The view looks along the -z axis of its frame.

    Attributes:
      pose: f32[12, M], row by row the 3 x 4 matrix from each geom's frame to the view's frame, in m.
      is_culled: f32[M], 1 where back faces of the geom are left out, else 0.
      pinhole: Pinhole.
      is_parallel: True for parallel rays, False for a perspective view; static.
    """

    pose: Array
    is_culled: Array
    pinhole: Pinhole
    is_parallel: bool


def _take(table: Array, index: Array) -> Array:
    return table.at[index].get(mode="promise_in_bounds")


def _rows_of_faces(table: Array, geom: Array) -> list[Array]:
    """Returns each row of `table` [R, M] for the geom of each face. A single geom needs no gather."""
    return [row[0] if table.shape[1] == 1 else _take(row, geom) for row in table]


def _to_view(projection: Projection, pose: list[Array], point: Vector) -> tuple[Array, Array, Array, Array]:
    """Returns homogeneous x, y and w of a corner in the view's frame, and its depth in m."""
    x, y, z = point
    rows = [pose[i] * x + pose[i + 1] * y + pose[i + 2] * z + pose[i + 3] for i in (0, 4, 8)]
    depth = -rows[2]
    return rows[0], rows[1], jnp.ones_like(depth) if projection.is_parallel else depth, depth


def _to_pixels(x: list[Array], w: list[Array], scale: Array, center: Array) -> list[Array]:
    """Returns the column or row in pixels of corners in front of the viewer; see `_pixel_interval`."""
    return [center + scale * a / jnp.where(b > _NEAR, b, 1.0) for a, b in zip(x, w, strict=True)]


def _pixel_interval(x: list[Array], w: list[Array], scale: Array, center: Array, count: int) -> Array:
    """Returns i32[T], the interval of pixels along one axis that may show each face; see `Pairs` for its bits.

    If all three corners are in front of the viewer, their pixels bound the face. If a corner is behind, the interval is
    the whole axis, except for faces that lie wholly outside one edge of the image. That test holds for any corners.

    Args:
      x: f32[T] for each of three corners, homogeneous coordinate along the axis.
      w: f32[T] for each of three corners.
      scale: f32[] pixels.
      center: f32[] pixels.
      count: number of pixels along the axis.
    """
    pixel = _to_pixels(x, w, scale, center)
    low_edge, high_edge = (-0.5 - center) / scale, (count - 0.5 - center) / scale
    is_outside = max_of_three([a - low_edge * b for a, b in zip(x, w, strict=True)]) < 0.0
    is_outside |= min_of_three([a - high_edge * b for a, b in zip(x, w, strict=True)]) > 0.0
    is_outside |= max_of_three(w) <= _NEAR
    is_crossing = min_of_three(w) <= _NEAR
    first = jnp.where(is_crossing, 0.0, jnp.clip(jnp.ceil(min_of_three(pixel) - _MARGIN), 0, count))
    stop = jnp.where(is_crossing, count, jnp.clip(jnp.floor(max_of_three(pixel) + _MARGIN) + 1.0, 0, count))
    stop = jnp.where(is_outside, first, jnp.maximum(first, stop))
    return first.astype(jnp.int32) | (stop.astype(jnp.int32) << 16)


def _is_front(x: list[Array], y: list[Array], w: list[Array]) -> Array:
    """Returns bool[T]: the corners run counterclockwise (the front is seen), or a corner is behind the viewer."""
    inverse = [1.0 / jnp.where(b > _NEAR, b, 1.0) for b in w]
    u, v = ([a * b for a, b in zip(axis, inverse, strict=True)] for axis in (x, y))
    area = (u[1] - u[0]) * (v[2] - v[0]) - (u[2] - u[0]) * (v[1] - v[0])
    return (area > 0.0) | (min_of_three(w) <= _NEAR)


def _bounding_strips(triangles: Triangles, projection: Projection, size: tuple[int, int], zero: Array) -> Strips:
    """Returns the strip that holds each face."""
    pose = _rows_of_faces(projection.pose, triangles.geom)
    points = [(corner[0], corner[1], corner[2]) for corner in triangles.corners]
    corners = (_to_view(projection, pose, point) for point in points)
    x, y, w, _ = (list(values) for values in zip(*corners, strict=True))
    pinhole = projection.pinhole
    columns = _pixel_interval(x, w, pinhole.scale_x, pinhole.center_x, size[1])
    rows = _pixel_interval([-a for a in y], w, pinhole.scale_y, pinhole.center_y, size[0])
    is_culled = _rows_of_faces(projection.is_culled[None], triangles.geom)[0]
    rows = jnp.where((is_culled > 0.0) & ~_is_front(x, y, w), 0, rows)
    u = _to_pixels(x, w, pinhole.scale_x, pinhole.center_x)
    v = _to_pixels([-a for a in y], w, pinhole.scale_y, pinhole.center_y)
    return materialize(narrow_strips(u, v, min_of_three(w) > _NEAR, columns, rows), zero)


def _depth_of_hits(
    triangles: Triangles, projection: Projection, face: Array, pixel: tuple[Array, Array], zero: Array
) -> Array:
    """Returns the depth at which rays meet faces (Woop et al. 2013; see the module's docstring).

    Args:
      triangles: Triangles.
      projection: Projection.
      face: i32[N].
      pixel: f32[N] column and f32[N] row of the pixels whose rays are tested.
      zero: see `materialize`.

    Returns:
      f32[N] m; +inf where the ray of a pixel misses the face.
    """
    pinhole = projection.pinhole
    ray_x = (pixel[0] - pinhole.center_x) / pinhole.scale_x
    ray_y = (pinhole.center_y - pixel[1]) / pinhole.scale_y
    table = triangles.corners.reshape(9, -1)
    axes = materialize([_take(row, face) for row in table], zero)
    geom = face if projection.pose.shape[1] == 1 else materialize(_take(triangles.geom, face), zero)
    pose = _rows_of_faces(projection.pose, geom)
    x: list[Array] = []
    y: list[Array] = []
    depth: list[Array] = []
    for i in (0, 3, 6):
        corner_x, corner_y, w, corner_depth = _to_view(projection, pose, (axes[i], axes[i + 1], axes[i + 2]))
        x.append(corner_x - ray_x * w)
        y.append(corner_y - ray_y * w)
        depth.append(corner_depth)
    areas = [x[1] * y[2] - x[2] * y[1], x[2] * y[0] - x[0] * y[2], x[0] * y[1] - x[1] * y[0]]
    total = areas[0] + areas[1] + areas[2]
    hit_depth = (areas[0] * depth[0] + areas[1] * depth[1] + areas[2] * depth[2]) / jnp.where(total == 0.0, 1.0, total)
    is_inside = ((min_of_three(areas) >= 0.0) | (max_of_three(areas) <= 0.0)) & (total != 0.0)
    return jnp.where(is_inside & (projection.is_parallel | (hit_depth > 0.0)), hit_depth, jnp.inf)


def _has_pairs_left(pairs: Pairs, state: tuple[Array, Array, Array]) -> Array:
    return state[0] < pairs.stop[-1]


def _test_batch(
    triangles: Triangles,
    projection: Projection,
    pairs: Pairs,
    context: tuple[tuple[int, int], Array],
    state: tuple[Array, Array, Array],
) -> tuple[Array, Array, Array]:
    """Tests the next batch of pairs. The state holds the next pair's number, and depth and face of each pixel."""
    (height, width), zero = context
    start, best, faces = state
    num_pixels = height * width
    face = faces_of_pairs(pairs, start, _BATCH, zero)
    strips, first = materialize(jax.tree.map(lambda t: _take(t, face), (pairs.strips, pairs.first)), zero)
    number = start + jnp.arange(_BATCH, dtype=jnp.int32)
    row, column, is_inside = materialize(pixels_of_pairs(strips, first, number), zero)
    pixel = (column.astype(jnp.float32), row.astype(jnp.float32))
    depth = materialize(_depth_of_hits(triangles, projection, face, pixel, zero), zero)
    is_hit = is_inside & (number < pairs.stop[-1]) & (depth < jnp.inf)
    target = materialize(jnp.where(is_hit, row * width + column, num_pixels), zero)
    best = best.at[target].min(depth, mode="drop")
    is_best = depth <= _take(best, jnp.minimum(target, num_pixels - 1))
    faces = faces.at[jnp.where(is_best, target, num_pixels)].set(face, mode="drop")
    return start + _BATCH, best, faces


def rasterize(triangles: Triangles, projection: Projection, size: tuple[int, int], zero: Array) -> Raster:
    """Draws triangles: returns for each pixel the nearest triangle (face) and its depth.

    Args:
      triangles: the faces of all geoms, each in the frame of its geom.
      projection: poses of these geoms in the frame of the view, and the view's mapping onto pixels.
      size: height and width of the image in pixels, each at most 32,767; static.
      zero: i32[], a 0 that the compiler does not know to be 0. It keeps XLA from computing results twice.

    Returns:
      Nearest face and depth of each pixel. All depths are NaN if there are more than about 2^31 pairs of a face and a
      pixel of its strip.
    """
    strips = _bounding_strips(triangles, projection, size, zero)
    count = count_pairs(strips)
    stop = materialize(jnp.cumsum(count), zero)
    pairs = Pairs(strips, materialize(stop - count, zero), stop)
    num_pixels = size[0] * size[1]
    initial = (jnp.zeros_like(zero), jnp.full(num_pixels, jnp.inf, jnp.float32), jnp.zeros(num_pixels, jnp.int32))
    step = functools.partial(_test_batch, triangles, projection, pairs, (size, zero))
    _, depth, face = jax.lax.while_loop(functools.partial(_has_pairs_left, pairs), step, initial)
    depth = jnp.where(jnp.sum(count.astype(jnp.float32)) < _MAX_PAIRS, depth, jnp.nan)
    return Raster(depth.reshape(size), face.reshape(size))
