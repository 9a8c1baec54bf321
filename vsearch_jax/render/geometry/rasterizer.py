"""A rasteriser for triangles: the nearest face of each pixel, with an exact ray–triangle test.

A visible face of a mesh covers only a few pixels. So it is cheaper to find the pixels of each face than to find the
face of each ray. The algorithm has three steps:

1. `project_faces` projects the corners of every face, and finds a strip of pixels that holds the face. The strip of a
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
    next_pairs,
    pixels_of_pairs,
)
from vsearch_jax.render.geometry.projection import ProjectedFaces, Projection, project_faces
from vsearch_jax.render.geometry.triangles import Triangles
from vsearch_jax.xla.batching import flatten_vmap
from vsearch_jax.xla.materialize import materialize, runtime_zero

# Pairs (face, pixel) that are tested at a time: for each image, and at most, on a CPU and on other platforms.
_BATCH, _MAX_CPU_BATCH, _MAX_BATCH = 4096, 16384, 2**20


class Raster(NamedTuple):
    """The nearest triangle (face) in each of H x W pixels.

    Attributes:
      depth: f32[H, W] m along the view's axis, +inf on a miss.
      face: i32[H, W], number of the face among those of all geoms of `Triangles`; 0 on a miss.
    """

    depth: Array
    face: Array


class _Corners(NamedTuple):
    """The corners of N faces: for each field of `ProjectedFaces` three f32[N], one for each corner."""

    x: list[Array]
    y: list[Array]
    w: list[Array]
    depth: list[Array] | None


def _take(table: Array, index: Array) -> Array:
    return table.at[index].get(mode="promise_in_bounds")


def _take_corners(table: Array, face: Array, num_faces: int) -> list[Array]:
    """Returns three f32[B], the values of the three corners of each of B faces.

    Args:
      table: f32[N * 3 * T]; axes are image, corner, face.
      face: i32[B], number of each face among the N * T faces of all images.
      num_faces: T.
    """
    first = face + 2 * num_faces * (face // num_faces)
    return [_take(table, first + corner * num_faces) for corner in range(3)]


def _depth_of_hits(faces: _Corners, row: Array, column: Array) -> Array:
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
    depth = faces.w if faces.depth is None else faces.depth
    products = [(x[i] * y[j], x[j] * y[i]) for i, j in ((1, 2), (2, 0), (0, 1))]
    areas = [a - b for a, b in products]
    total = areas[0] + areas[1] + areas[2]
    hit_depth = (areas[0] * depth[0] + areas[1] * depth[1] + areas[2] * depth[2]) / jnp.where(total == 0.0, 1.0, total)
    # The areas of a thin face are not exact enough for a mean.
    hit_depth = jnp.clip(hit_depth, min_of_three(depth), max_of_three(depth))
    # The products are compared, because a fused multiply-subtract rounds one of them only: on an edge that two faces
    # share, both areas could be negative, and the ray would slip between the faces.
    is_left, is_right = ([compare(a, b) for a, b in products] for compare in (jnp.greater_equal, jnp.less_equal))
    is_inside = ((is_left[0] & is_left[1] & is_left[2]) | (is_right[0] & is_right[1] & is_right[2])) & (total != 0.0)
    return jnp.where(is_inside & ((faces.depth is not None) | (hit_depth > 0.0)), hit_depth, jnp.inf)


def _draw_images(size: tuple[int, int], shared: tuple[()], faces: ProjectedFaces) -> Raster:
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
    zero = runtime_zero(faces.w[:, 0, :1])
    flat: ProjectedFaces = jax.tree.map(lambda x: x.reshape(-1), faces)
    queue = materialize(make_queue(count_pairs(flat.strips), batch_size), zero)

    def test_batch(state: tuple[Position, Array, Array]) -> tuple[Position, Array, Array]:
        position, best, nearest = state
        face, rank, is_pair, position = next_pairs(queue, position, batch_size, zero)
        strips: Strips = jax.tree.map(lambda table: _take(table, face), flat.strips)
        corners = _Corners(*jax.tree.map(lambda table: _take_corners(table, face, num_faces), flat[1:]))
        strips, corners = materialize((strips, corners), zero)
        row, column, is_inside = materialize(pixels_of_pairs(strips, rank), zero)
        depth = materialize(_depth_of_hits(corners, row.astype(jnp.float32), column.astype(jnp.float32)), zero)
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
    faces = project_faces(triangles, projection, size, zero)
    draw = flatten_vmap(functools.partial(_draw_images, size))
    return jax.tree.map(lambda x: x[0], draw((), jax.tree.map(lambda x: x[None], faces)))
