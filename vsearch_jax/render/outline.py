"""Functions of an object's outline: a silhouette with derivatives, and a square crop."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from vsearch_jax.render.cameras import pinhole, pixel_rays
from vsearch_jax.render.image import render, silhouette
from vsearch_jax.render.mj_poses import GeomPoses
from vsearch_jax.render.scene import RenderScene
from vsearch_jax.types import Camera

# Radius in pixels within which a pixel searches for the outline.
_SEARCH_RADIUS = 3


def soft_silhouette(
    scene: RenderScene,
    data: GeomPoses,
    camera: Camera,
    size: tuple[int, int],
    geom_ids: tuple[int, ...],
    softness: float = 0.7,
) -> Array:
    """Renders a differentiable silhouette of some geoms. Its derivatives follow the motion of the outline.

    The silhouette is a logistic function of the distance to the outline. The outline is taken to move with the visible
    surface points next to it. At the rim of a curved surface, outline and surface points move alike in the image, so
    this is exact to first order. Derivatives are with respect to the camera and the poses of the geoms. Where another
    geom hides a part of the geoms, the border of the visible part counts as outline too.

    Args:
      scene: shapes of the geoms, from `compile_scene`.
      data: poses of the geoms, as for `render`.
      camera: the camera in the world frame.
      size: height H and width W of the image in pixels, static.
      geom_ids: MuJoCo's numbers of the geoms in the silhouette, static.
      softness: scale of the logistic function in pixels. The value is 0.5 on the outline, 0.27 at this distance
        outside, and 0.73 at this distance inside.

    Returns:
      Silhouette f32[H, W], 1 inside and 0 outside. Values between lie within 3 pixels of the outline.
    """
    image = jax.lax.stop_gradient(render(scene, data, camera, size))
    mask = silhouette(image, geom_ids)
    pixels = pinhole(camera, size)
    x, y = jax.lax.stop_gradient(pixel_rays(pixels, size))
    depth = jnp.where(mask, image.depth, 1.0)
    points = jnp.stack([x * depth, y * depth, -depth], axis=-1)
    moved = _attach_to_geoms(points, jnp.maximum(image.geom_id, 0), data, camera)
    away = jnp.maximum(-moved[..., 2], 1e-6)
    column = pixels.center_x + pixels.scale_x * moved[..., 0] / away
    row = pixels.center_y - pixels.scale_y * moved[..., 1] / away
    # The displacement of each point in the image. Its value is 0; only its derivatives count.
    shift = jnp.where(mask[..., None], jnp.stack([row, column], axis=-1), 0.0)
    shift = shift - jax.lax.stop_gradient(shift)
    distance = _outline_distance(mask, shift)
    is_far = jnp.abs(distance) > _SEARCH_RADIUS
    return jnp.where(is_far, mask.astype(jnp.float32), jax.nn.sigmoid(-distance / softness))


def _attach_to_geoms(points: Array, geom: Array, data: GeomPoses, camera: Camera) -> Array:
    """Returns `points` unchanged, with derivatives as if each point were fixed to its geom.

    Args:
      points: f32[H, W, 3] m, in the camera's frame.
      geom: i32[H, W], MuJoCo's geom number of each point.
      data: poses.
      camera: Camera.

    Returns:
      f32[H, W, 3] m, in the camera's frame.
    """
    rotation, position = jnp.asarray(data.geom_xmat).reshape(-1, 3, 3)[geom], jnp.asarray(data.geom_xpos)[geom]
    world = jax.lax.stop_gradient(points @ camera.rotation.T + camera.position[None, None])
    fixed_rotation, fixed_position = jax.lax.stop_gradient((rotation, position))
    local = jnp.einsum("hwji,hwj->hwi", fixed_rotation, world - fixed_position)
    return (jnp.einsum("hwij,hwj->hwi", rotation, local) + position - camera.position[None, None]) @ camera.rotation


def _outline_distance(mask: Array, shift: Array) -> Array:
    """Returns f32[H, W] pixels, the signed distance to the outline, negative inside, at most `_SEARCH_RADIUS` + 1.

    Args:
      mask: bool[H, W], the silhouette.
      shift: f32[H, W, 2] pixels, displacement (row, column) of each point inside; its value is 0.
    """
    height, width = mask.shape
    pad = ((_SEARCH_RADIUS, _SEARCH_RADIUS), (_SEARCH_RADIUS, _SEARCH_RADIUS))
    wide_mask, wide_shift = jnp.pad(mask, pad, mode="edge"), jnp.pad(shift, (*pad, (0, 0)))
    best = jnp.full(mask.shape, _SEARCH_RADIUS + 1.0) * jnp.where(mask, -1.0, 1.0)
    span = range(-_SEARCH_RADIUS, _SEARCH_RADIUS + 1)
    for i, j in ((i, j) for i in span for j in span if 0 < i * i + j * j <= _SEARCH_RADIUS * _SEARCH_RADIUS):
        length = float(np.hypot(i, j))
        first_row, first_column = _SEARCH_RADIUS + i, _SEARCH_RADIUS + j
        other = (slice(first_row, first_row + height), slice(first_column, first_column + width))
        # The outline is half a pixel outside the inner one of the two pixels, and moves with it.
        inner_shift = jnp.where(mask[..., None], shift, wide_shift[other])
        along = (inner_shift[..., 0] * i + inner_shift[..., 1] * j) / length
        # (i, j) points outwards if this pixel is the inner one, and inwards if it is the outer one.
        distance = jnp.where(mask, -(length - 0.5) - along, length - 0.5 + along)
        is_nearer = (wide_mask[other] != mask) & (length - 0.5 < jnp.abs(jax.lax.stop_gradient(best)))
        best = jnp.where(is_nearer, distance, best)
    return best


class Square(NamedTuple):
    """A square part of an image.

    Attributes:
      row: f32[] pixels, row of its centre, 0 at the upper edge of the image.
      column: f32[] pixels, column of its centre, 0 at the left edge of the image.
      edge: f32[] pixels, length of its edge.
    """

    row: Array
    column: Array
    edge: Array


def square_around(mask: Array, margin: float = 0.1) -> Square:
    """Returns the square part of an image that holds all true pixels of a mask, for example an object's silhouette.

    The square has the centre of the bounding box of the true pixels.

    Args:
      mask: bool[H, W], the image has H x W pixels. Without a true pixel, the result is the largest square in the middle
        of the image.
      margin: extra width on each side, as a fraction of the longer edge of the bounding box.
    """
    (top, bottom), (left, right) = (_extent(jnp.any(mask, axis=axis)) for axis in (1, 0))
    edge = jnp.maximum(bottom - top, right - left) * (1.0 + 2.0 * margin)
    is_seen, (height, width) = jnp.any(mask), mask.shape
    return Square(
        jnp.where(is_seen, 0.5 * (top + bottom), 0.5 * height),
        jnp.where(is_seen, 0.5 * (left + right), 0.5 * width),
        jnp.where(is_seen, edge, float(min(height, width))),
    )


def _extent(is_set: Array) -> tuple[Array, Array]:
    """Returns f32[] each, the index of the first true entry and the index after the last, of bool[N]."""
    count = is_set.shape[0]
    return jnp.argmax(is_set).astype(jnp.float32), (count - jnp.argmax(is_set[::-1])).astype(jnp.float32)


def crop(pixels: Array, square: Square, size: int) -> Array:
    """Cuts a square part out of an image and resizes the part to `size` x `size` pixels with linear interpolation.

    Args:
      pixels: image f32[H, W, C] of H x W pixels and C channels.
      square: the part to cut out. Beyond the edges of the image the result is 0.
      size: number of rows and of columns of the result, static.

    Returns:
      Resized part, f32[size, size, C].
    """
    scale = jnp.full(2, size / square.edge)
    corner = jnp.stack([square.row, square.column]) - 0.5 * square.edge
    shape = (size, size, pixels.shape[-1])
    return jax.image.scale_and_translate(pixels, shape, (0, 1), scale, -corner * scale, method="linear")
