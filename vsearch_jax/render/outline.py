"""What needs an outline rather than its inside: a silhouette with gradients, and a crop around an object."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from vsearch_jax.render.cameras import pinhole, pixel_rays
from vsearch_jax.render.image import render, silhouette
from vsearch_jax.render.scene import RenderScene
from vsearch_jax.types import Camera

# How far around it, in pixels, a pixel looks for the outline.
_REACH = 3


def _moved(points: Array, geom: Array, data: Any, camera: Camera) -> Array:
    """Returns f32[H, W, 3], in the camera's frame, `points` of it that move with their geoms and the camera."""
    rotation, position = jnp.asarray(data.geom_xmat).reshape(-1, 3, 3)[geom], jnp.asarray(data.geom_xpos)[geom]
    world = jax.lax.stop_gradient(points @ camera.rotation.T + camera.position[None, None])
    fixed_rotation, fixed_position = jax.lax.stop_gradient((rotation, position))
    local = jnp.einsum("hwji,hwj->hwi", fixed_rotation, world - fixed_position)
    return (jnp.einsum("hwij,hwj->hwi", rotation, local) + position - camera.position[None, None]) @ camera.rotation


def soft_silhouette(
    scene: RenderScene,
    data: Any,
    camera: Camera,
    size: tuple[int, int],
    geom_ids: tuple[int, ...],
    softness: float = 0.7,
) -> Array:
    """Returns how far each pixel is within the outline of some geoms, with derivatives that move the outline.

    Where a surface turns away from the eye, its points and its outline move alike across the image, so the outline
    follows the points seen next to it. That holds for what the geoms' poses and the camera do, and to first order.
    Where something stands before the geoms, the edge of what is seen of them counts as theirs too.

    Args:
      scene: RenderScene.
      data: see `render`.
      camera: Camera.
      size: height and width in pixels, static.
      geom_ids: MuJoCo's numbers of the geoms, static.
      softness: pixels from the outline, 0.5, to 0.27 outside of it and 0.73 inside.

    Returns:
      f32[H, W]: 0 and 1 more than three pixels from the outline, a logistic function of the distance nearer to it.
    """
    image = jax.lax.stop_gradient(render(scene, data, camera, size))
    mask = silhouette(image, geom_ids)
    pixels = pinhole(camera, size)
    x, y = jax.lax.stop_gradient(pixel_rays(pixels, size))
    depth = jnp.where(mask, image.depth, 1.0)
    points = jnp.stack([x * depth, y * depth, -depth], axis=-1)
    moved = _moved(points, jnp.maximum(image.geom_id, 0), data, camera)
    away = jnp.maximum(-moved[..., 2], 1e-6)
    column = pixels.center_x + pixels.scale_x * moved[..., 0] / away
    row = pixels.center_y - pixels.scale_y * moved[..., 1] / away
    # Where each point of the image has gone, a shift that is zero in value.
    shift = jnp.where(mask[..., None], jnp.stack([row, column], axis=-1), 0.0)
    shift = shift - jax.lax.stop_gradient(shift)
    distance = _distance(mask, shift)
    return jnp.where(jnp.abs(distance) > _REACH, mask.astype(jnp.float32), jax.nn.sigmoid(-distance / softness))


def _distance(mask: Array, shift: Array) -> Array:
    """Returns f32[H, W], how far outside (above 0) or inside the outline a pixel is, up to `_REACH` + 1."""
    height, width = mask.shape
    pad = ((_REACH, _REACH), (_REACH, _REACH))
    wide_mask, wide_shift = jnp.pad(mask, pad, mode="edge"), jnp.pad(shift, (*pad, (0, 0)))
    best = jnp.full(mask.shape, _REACH + 1.0) * jnp.where(mask, -1.0, 1.0)
    span = range(-_REACH, _REACH + 1)
    for i, j in ((i, j) for i in span for j in span if 0 < i * i + j * j <= _REACH * _REACH):
        length = float(np.hypot(i, j))
        other = (slice(_REACH + i, _REACH + i + height), slice(_REACH + j, _REACH + j + width))
        # The outline is half a pixel beyond the last point that is seen; it moves with the point of the two within.
        within = jnp.where(mask[..., None], shift, wide_shift[other])
        along = (within[..., 0] * i + within[..., 1] * j) / length
        # `along` points away from an inner pixel, towards the point of an outer one.
        distance = jnp.where(mask, -(length - 0.5) - along, length - 0.5 + along)
        is_nearer = (wide_mask[other] != mask) & (length - 0.5 < jnp.abs(jax.lax.stop_gradient(best)))
        best = jnp.where(is_nearer, distance, best)
    return best


class Square(NamedTuple):
    """A square part of an image.

    Attributes:
      row: f32[] pixels, of its centre.
      column: f32[] pixels.
      edge: f32[] pixels.
    """

    row: Array
    column: Array
    edge: Array


def square_around(mask: Array, margin: float = 0.1) -> Square:
    """Returns the square around what `mask` shows, `margin` of its edge wider on each side.

    Args:
      mask: bool[H, W]; if it shows nothing, the square is the image's largest.
      margin: part of the longer edge of the bounding box.
    """
    (top, bottom), (left, right) = (_ends(jnp.any(mask, axis=axis)) for axis in (1, 0))
    edge = jnp.maximum(bottom - top, right - left) * (1.0 + 2.0 * margin)
    is_seen, (height, width) = jnp.any(mask), mask.shape
    return Square(
        jnp.where(is_seen, 0.5 * (top + bottom), 0.5 * height),
        jnp.where(is_seen, 0.5 * (left + right), 0.5 * width),
        jnp.where(is_seen, edge, float(min(height, width))),
    )


def _ends(is_there: Array) -> tuple[Array, Array]:
    count = is_there.shape[0]
    return jnp.argmax(is_there).astype(jnp.float32), (count - jnp.argmax(is_there[::-1])).astype(jnp.float32)


def crop(picture: Array, square: Square, size: int) -> Array:
    """Returns f32[size, size, C], the part `square` of `picture` f32[H, W, C] resized; 0 beyond the picture's edges."""
    scale = jnp.full(2, size / square.edge)
    corner = jnp.stack([square.row, square.column]) - 0.5 * square.edge
    shape = (size, size, picture.shape[-1])
    return jax.image.scale_and_translate(picture, shape, (0, 1), scale, -corner * scale, method="linear")
