"""A rasteriser for triangles: the nearest face of each pixel, with an exact ray–triangle test.

A visible face of a mesh covers only a few pixels. So it is cheaper to find the pixels of each face than to find the
face of each ray. The algorithm has three steps:

1. `_project_faces` projects the corners of every face, and finds a strip of pixels that holds the face. The strip of a
   long, slanted face is narrow; CAD programs make many such faces. Faces outside the image and culled faces get an
   empty strip.
2. The pairs (face, pixel of its strip) of all faces form one long queue; see `render.geometry.pairs`. A loop takes the
   next pairs from the queue, a fixed number at a time.
3. For each pair, the ray through the pixel's centre is tested against the face. The nearest hit of each pixel is kept
   (a depth buffer, by a scatter of minima).

The test is that of Woop, Benthin and Wald, "Watertight Ray/Triangle Intersection", JCGT 2(1), 2013: the corners are
sheared so that the ray becomes the z axis, then the signs of three areas tell on which side of each edge the ray is.
Two faces that share an edge compute the area of that edge from the same numbers, so no ray slips between them.

Step 1 costs a few passes over the faces. Steps 2 and 3 cost as much as there are pairs, and that number depends on the
image more than on the number of faces. Under `vmap` the faces of all images share one queue. With a queue for each
image, all images would pay for the image with the most pairs.
"""

from __future__ import annotations

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from vsearch_jax.render.geometry.pairs import (
    Position,
    Strips,
    count_pairs,
    make_queue,
    max_of_three,
    min_of_three,
    narrow_strips,
    next_pairs,
    pixels_of_pairs,
)
from vsearch_jax.render.geometry.triangles import Triangles
from vsearch_jax.xla.batching import flatten_vmap
from vsearch_jax.xla.materialize import materialize, runtime_zero
from vsearch_jax.xla.vectors import Vector

# m. A face that comes closer than this to the plane of the viewer is not projected; it is tested in all pixels.
_NEAR = 1e-6
# Pixels. Rectangles grow by this, which is far more than the rounding error of a projected corner.
_MARGIN = 1e-3
# Pairs (face, pixel) that are tested at a time: for each image, and at most, on a CPU and on other platforms.
_BATCH, _MAX_CPU_BATCH, _MAX_BATCH = 4096, 16384, 2**20


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


class _Faces(NamedTuple):
    """T faces as a view sees them. (column, row) = (x / w, y / w) are the pixels of a corner in front of the viewer.

    Attributes:
      strips: the pixels that may show each face.
      x: f32[T] for each of three corners.
      y: f32[T] for each of three corners.
      w: f32[T] for each of three corners; 1 in a parallel view, else the depth in m.
      depth: f32[T] m for each of three corners. Empty in a perspective view, where w is the depth.
    """

    strips: Strips
    x: tuple[Array, ...]
    y: tuple[Array, ...]
    w: tuple[Array, ...]
    depth: tuple[Array, ...]


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
    """Returns i32[T], the interval of pixels along one axis that may show each face; see `Strips` for its bits.

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


def _project_faces(triangles: Triangles, projection: Projection, size: tuple[int, int], zero: Array) -> _Faces:
    """Returns the corners of each face in pixels, and the strip that holds the face."""
    pose = _rows_of_faces(projection.pose, triangles.geom)
    points = [(corner[0], corner[1], corner[2]) for corner in triangles.corners]
    corners = (_to_view(projection, pose, point) for point in points)
    x, y, w, depth = (list(values) for values in zip(*corners, strict=True))
    is_front, pinhole = _is_front(x, y, w), projection.pinhole
    y = [-a for a in y]  # rows count downwards
    columns = _pixel_interval(x, w, pinhole.scale_x, pinhole.center_x, size[1])
    rows = _pixel_interval(y, w, pinhole.scale_y, pinhole.center_y, size[0])
    is_culled = _rows_of_faces(projection.is_culled[None], triangles.geom)[0]
    rows = jnp.where((is_culled > 0.0) & ~is_front, 0, rows)
    u = _to_pixels(x, w, pinhole.scale_x, pinhole.center_x)
    v = _to_pixels(y, w, pinhole.scale_y, pinhole.center_y)
    strips = narrow_strips(u, v, min_of_three(w) > _NEAR, columns, rows)
    faces = _Faces(
        strips,
        tuple(pinhole.scale_x * a + pinhole.center_x * b for a, b in zip(x, w, strict=True)),
        tuple(pinhole.scale_y * a + pinhole.center_y * b for a, b in zip(y, w, strict=True)),
        tuple(w),
        tuple(depth) if projection.is_parallel else (),
    )
    return materialize(faces, zero)


def _depth_of_hits(faces: _Faces, row: Array, column: Array) -> Array:
    """Returns the depth at which rays meet faces (Woop et al. 2013; see the module's docstring).

    Args:
      faces: N faces.
      row: f32[N], row of the pixel whose ray is tested against each face.
      column: f32[N], column of that pixel.

    Returns:
      f32[N] m; +inf where the ray of a pixel misses the face.
    """
    x = [a - column * b for a, b in zip(faces.x, faces.w, strict=True)]
    y = [a - row * b for a, b in zip(faces.y, faces.w, strict=True)]
    depth = faces.depth or faces.w
    products = [(x[i] * y[j], x[j] * y[i]) for i, j in ((1, 2), (2, 0), (0, 1))]
    areas = [a - b for a, b in products]
    total = areas[0] + areas[1] + areas[2]
    hit_depth = (areas[0] * depth[0] + areas[1] * depth[1] + areas[2] * depth[2]) / jnp.where(total == 0.0, 1.0, total)
    # The products are compared, because a fused multiply-subtract rounds one of them only: on an edge that two faces
    # share, both areas could be negative, and the ray would slip between the faces.
    is_left, is_right = ([compare(a, b) for a, b in products] for compare in (jnp.greater_equal, jnp.less_equal))
    is_inside = ((is_left[0] & is_left[1] & is_left[2]) | (is_right[0] & is_right[1] & is_right[2])) & (total != 0.0)
    is_parallel = bool(faces.depth)
    return jnp.where(is_inside & (is_parallel | (hit_depth > 0.0)), hit_depth, jnp.inf)


def _draw_images(size: tuple[int, int], shared: tuple[()], faces: _Faces) -> Raster:
    """Returns the nearest face of each pixel of N images.

    Args:
      size: height and width of an image in pixels.
      shared: nothing; `flatten_vmap` calls its function so.
      faces: the faces of each image: arrays [N, T].
    """
    del shared
    num_images, num_faces = faces.strips.rows.shape
    num_pixels = size[0] * size[1]
    batch_size = min(_BATCH * num_images, _MAX_CPU_BATCH if jax.default_backend() == "cpu" else _MAX_BATCH)
    zero = runtime_zero(faces.w[0][:, :1])
    flat: _Faces = jax.tree.map(lambda x: x.reshape(-1), faces)
    queue = materialize(make_queue(count_pairs(flat.strips), batch_size), zero)

    def test_batch(state: tuple[Position, Array, Array]) -> tuple[Position, Array, Array]:
        position, best, nearest = state
        face, rank, is_pair, position = next_pairs(queue, position, batch_size, zero)
        own: _Faces = materialize(jax.tree.map(lambda table: _take(table, face), flat), zero)
        row, column, is_inside = materialize(pixels_of_pairs(own.strips, rank), zero)
        depth = materialize(_depth_of_hits(own, row.astype(jnp.float32), column.astype(jnp.float32)), zero)
        pixel = (face // num_faces) * num_pixels + row * size[1] + column
        target = jnp.where(is_pair & is_inside & (depth < jnp.inf), pixel, num_images * num_pixels)
        target = materialize(target, zero)
        best = best.at[target].min(depth, mode="drop")
        is_nearest = depth <= _take(best, jnp.minimum(target, num_images * num_pixels - 1))
        target = jnp.where(is_nearest, target, num_images * num_pixels)
        return position, best, nearest.at[target].set(face % num_faces, mode="drop")

    none = jnp.full(num_images * num_pixels, jnp.inf, jnp.float32), jnp.zeros(num_images * num_pixels, jnp.int32)
    initial = (Position(jnp.zeros_like(zero), jnp.zeros_like(zero)), *none)
    _, depth, nearest = jax.lax.while_loop(lambda state: state[0].entry < queue.length, test_batch, initial)
    return Raster(depth.reshape(num_images, *size), nearest.reshape(num_images, *size))


def rasterize(triangles: Triangles, projection: Projection, size: tuple[int, int], zero: Array) -> Raster:
    """Draws triangles: returns for each pixel the nearest triangle (face) and its depth.

    Args:
      triangles: the faces of all geoms, each in the frame of its geom.
      projection: poses of these geoms in the frame of the view, and the view's mapping onto pixels.
      size: height and width of the image in pixels, each at most 32,767; static.
      zero: i32[], a 0 that the compiler does not know to be 0. It keeps XLA from computing results twice.

    Returns:
      Nearest face and depth of each pixel.
    """
    faces = _project_faces(triangles, projection, size, zero)
    draw = flatten_vmap(functools.partial(_draw_images, size))
    return jax.tree.map(lambda x: x[0], draw((), jax.tree.map(lambda x: x[None], faces)))
