"""Projects triangles onto the pixels of a view."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from vsearch_jax.render.geometry.pairs import Strips, max_of_three, min_of_three, narrow_strips
from vsearch_jax.render.geometry.triangles import Triangles
from vsearch_jax.xla.materialize import materialize

# m. A face that comes closer than this to the plane of the viewer is not projected; it is tested in all pixels.
_NEAR = 1e-6
# A face is too thin to be culled if its area is less than this times its perimeter (a slope, or m in a parallel view).
_THIN = 1e-6
# Pixels. Rectangles grow by this, which is far more than the rounding error of a projected corner.
_MARGIN = 1e-3


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


class ProjectedFaces(NamedTuple):
    """T faces as a view sees them. (column, row) = (x / w, y / w) are the pixels of a corner in front of the viewer.

    Attributes:
      strips: the pixels that may show each face.
      x: f32[3, T]; axes are corner, face.
      y: f32[3, T].
      w: f32[3, T]; 1 in a parallel view, else the depth in m.
      depth: f32[3, T] m. None in a perspective view, where w is the depth.
    """

    strips: Strips
    x: Array
    y: Array
    w: Array
    depth: Array | None


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


def _rows_of_faces(table: Array, geom: Array) -> list[Array]:
    """Returns each row of `table` [R, M] for the geom of each face. A single geom needs no gather."""
    return [row[0] if table.shape[1] == 1 else row.at[geom].get(mode="promise_in_bounds") for row in table]


def _to_view(projection: Projection, geom: Array, corners: Array, zero: Array) -> tuple[Array, Array, Array]:
    """Returns x, y and depth of all corners in the view's frame, f32[3, T] m each; y counts downwards, as rows do.

    One expression computes all three corners. So a vertex gets the same bits in each of its faces, whichever of their
    corners it is. With an expression for each corner, the compiler could contract them to different fused
    multiply-adds, and a ray could slip between two faces.

    Args:
      projection: poses of the geoms in the view's frame.
      geom: i32[T], geom of each face.
      corners: f32[3, 3, T] m; axes are corner, coordinate, face.
      zero: i32[], see `project_faces`.
    """
    pose = [row.reshape(1, -1) for row in materialize(_rows_of_faces(projection.pose, geom), zero)]
    x, y, z = corners[:, 0], corners[:, 1], corners[:, 2]
    rows = [pose[i] * x + pose[i + 1] * y + pose[i + 2] * z + pose[i + 3] for i in (0, 4, 8)]
    return materialize((rows[0], -rows[1], -rows[2]), zero)


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


def _is_back(x: Array, y: Array, w: Array) -> Array:
    """Returns bool[T]: the corners run clockwise as the viewer sees them, so that the back of the face is seen.

    False if a corner is behind the viewer. False also for faces so thin that rounding decides on which side they are
    seen: without them, their neighbours would leave a gap.
    """
    inverse = 1.0 / jnp.where(w > _NEAR, w, 1.0)
    u, v = x * inverse, y * inverse
    sides = u[1] - u[0], v[1] - v[0], u[2] - u[0], v[2] - v[0]
    area = sides[0] * sides[3] - sides[2] * sides[1]
    perimeter = jnp.abs(sides[0]) + jnp.abs(sides[1]) + jnp.abs(sides[2]) + jnp.abs(sides[3])
    return (area > _THIN * perimeter) & (min_of_three(list(w)) > _NEAR)


def project_faces(triangles: Triangles, projection: Projection, size: tuple[int, int], zero: Array) -> ProjectedFaces:
    """Projects T faces: returns their corners in pixels, and the strip of pixels that holds each face.

    Args:
      triangles: the faces of all geoms, each in the frame of its geom.
      projection: poses of these geoms in the frame of the view, and the view's mapping onto pixels.
      size: height and width of the image in pixels, static.
      zero: i32[], a 0 that the compiler does not know to be 0. It keeps XLA from computing results twice.
    """
    pinhole = projection.pinhole
    x, y, depth = _to_view(projection, triangles.geom, triangles.corners_of_geoms, zero)
    w = jnp.ones_like(depth) if projection.is_parallel else depth
    columns = _pixel_interval(list(x), list(w), pinhole.scale_x, pinhole.center_x, size[1])
    rows = _pixel_interval(list(y), list(w), pinhole.scale_y, pinhole.center_y, size[0])
    is_culled = _rows_of_faces(projection.is_culled[None], triangles.geom)[0]
    rows = jnp.where((is_culled > 0.0) & _is_back(x, y, w), 0, rows)
    u = _to_pixels(list(x), list(w), pinhole.scale_x, pinhole.center_x)
    v = _to_pixels(list(y), list(w), pinhole.scale_y, pinhole.center_y)
    faces = ProjectedFaces(
        narrow_strips(u, v, min_of_three(list(w)) > _NEAR, columns, rows),
        pinhole.scale_x * x + pinhole.center_x * w,
        pinhole.scale_y * y + pinhole.center_y * w,
        w,
        depth if projection.is_parallel else None,
    )
    return materialize(faces, zero)
