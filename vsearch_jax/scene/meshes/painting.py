"""Paints the colours of triangles into a texture.

The six axis directions sort the triangles by their normals. Each group is projected along its direction onto a tile of
the texture. Where triangles of a group hide others, the hidden ones go to a further tile, layer by layer. So texture
coordinates are continuous over a surface, which mipmaps need.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.ndimage import distance_transform_edt

# Texels along one side of a tile, and of the margin on each side. The longest edge of the mesh fits between margins.
_TILE, _MARGIN = 512, 2.0
# A mesh that needs more layers shows some wrong colours, where triangles of the last layer lie behind one another.
_MAX_LAYERS = 16
_TINY = 1e-300


class _Samples(NamedTuple):
    """N pairs of a triangle and a texel that it covers. A triangle without a texel's centre gets one texel.

    Attributes:
      face: int[N], number of the triangle.
      row: int[N], row of the texel in its tile.
      column: int[N], column of the texel in its tile.
      weights: f64[N, 3], barycentric coordinates in the triangle.
      is_small: bool[N], whether the triangle holds no texel's centre.
    """

    face: np.ndarray
    row: np.ndarray
    column: np.ndarray
    weights: np.ndarray
    is_small: np.ndarray


def paint_texture(corners: np.ndarray, colours: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Paints the colours of F triangles into one texture.

    A texel is 1/508 of the mesh's longest edge. Details below that are lost.

    Args:
      corners: f64[F, 3, 3], positions of the corners, in any unit.
      colours: f32[F, 3, 3] in [0, 1], colours at the corners. They change linearly in between.

    Returns:
      u8[H, W, 3], the texture, top row first; and f64[F, 3, 2], texture coordinates of the corners, v upwards.
    """
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    axis = np.argmax(np.abs(normal), axis=1)
    rows = np.arange(len(corners))
    is_negative = normal[rows, axis] < 0.0
    low = corners.min(axis=(0, 1))
    texel = max(float(np.ptp(corners, axis=(0, 1)).max()), _TINY) / (_TILE - 2.0 * _MARGIN)
    scaled = (corners - low) / texel
    # In texels: x and y in the tile, and the distance behind the front.
    place = np.stack([scaled[rows, :, (axis + 1) % 3], scaled[rows, :, (axis + 2) % 3]], axis=-1) + _MARGIN
    depth = scaled[rows, :, axis] * np.where(is_negative, 1.0, -1.0)[:, None]
    samples = _covered_texels(place)
    direction = 2 * axis + is_negative
    layer = _layers(samples, direction, np.sum(samples.weights * depth[samples.face], axis=1))
    tiles, tile = np.unique(direction * _MAX_LAYERS + layer, return_inverse=True)
    painted = np.sum(samples.weights[..., None] * colours[samples.face], axis=1)
    image = _paint_tiles(samples, tile, len(tiles), painted)
    num_columns = int(np.ceil(np.sqrt(len(tiles))))
    num_rows = -(-len(tiles) // num_columns)
    image = np.concatenate([image, np.zeros((num_rows * num_columns - len(tiles), _TILE, _TILE, 3), np.uint8)])
    image = image.reshape(num_rows, num_columns, _TILE, _TILE, 3).swapaxes(1, 2)
    origin = np.stack([tile % num_columns, tile // num_columns], axis=-1)[:, None] * _TILE
    texcoords = (place + origin) / [num_columns * _TILE, num_rows * _TILE]
    texcoords[..., 1] = 1.0 - texcoords[..., 1]
    return image.reshape(num_rows * _TILE, num_columns * _TILE, 3), texcoords


def _covered_texels(place: np.ndarray) -> _Samples:
    """Returns the texels that each triangle covers. `place` is f64[F, 3, 2], x and y of the corners in texels."""
    first = np.ceil(place.min(axis=1) - 0.5).astype(int)
    count = np.maximum(np.floor(place.max(axis=1) - 0.5).astype(int) - first + 1, 0)
    total = count[:, 0] * count[:, 1]
    face = np.repeat(np.arange(len(place)), total)
    number = np.arange(len(face)) - np.repeat(np.cumsum(total) - total, total)
    column, row = first[face, 0] + number % count[face, 0], first[face, 1] + number // count[face, 0]
    weights = _barycentric(place[face], np.stack([column, row], axis=-1) + 0.5)
    is_inside = np.all(weights >= -1e-9, axis=1)
    face, row, column, weights = face[is_inside], row[is_inside], column[is_inside], weights[is_inside]
    small = np.flatnonzero(np.bincount(face, minlength=len(place)) == 0)
    middle = place[small].mean(axis=1).astype(int)
    return _Samples(
        face=np.concatenate([face, small]),
        row=np.concatenate([row, middle[:, 1]]),
        column=np.concatenate([column, middle[:, 0]]),
        weights=np.concatenate([weights, np.full((len(small), 3), 1.0 / 3.0)]),
        is_small=np.arange(len(face) + len(small)) >= len(face),
    )


def _barycentric(triangle: np.ndarray, point: np.ndarray) -> np.ndarray:
    """Returns f64[N, 3], barycentric coordinates of points f64[N, 2] in triangles f64[N, 3, 2]."""
    (bx, by), (cx, cy), (px, py) = ((v - triangle[:, 0]).T for v in (triangle[:, 1], triangle[:, 2], point))
    area = bx * cy - by * cx
    area = np.where(np.abs(area) > _TINY, area, np.inf)
    weight_b, weight_c = (px * cy - py * cx) / area, (bx * py - by * px) / area
    return np.stack([1.0 - weight_b - weight_c, weight_b, weight_c], axis=-1)


def _layers(samples: _Samples, direction: np.ndarray, depth: np.ndarray) -> np.ndarray:
    """Returns the layer of each triangle, int[F]. A layer holds what nothing hides once earlier layers are taken away.

    Args:
      samples: covered texels.
      direction: int[F], the direction along which each triangle is projected, 0 to 5.
      depth: f64[N] texels, distance of each sample behind the front.
    """
    texel = (direction[samples.face] * _TILE + samples.row) * _TILE + samples.column
    # Neighbours share no texel's centre. A small triangle's depth is not that of the centre of its texel.
    slack = np.where(samples.is_small, 3.0, 1e-3)
    layer = np.full(len(direction), _MAX_LAYERS - 1)
    is_left = np.ones(len(direction), bool)
    for number in range(_MAX_LAYERS - 1):
        active = np.flatnonzero(is_left[samples.face])
        front = np.full(6 * _TILE * _TILE, np.inf)
        np.minimum.at(front, texel[active], depth[active])
        is_hidden = np.zeros(len(direction), bool)
        is_hidden[samples.face[active[depth[active] > front[texel[active]] + slack[active]]]] = True
        layer[is_left & ~is_hidden] = number
        is_left &= is_hidden
        if not is_left.any():
            break
    return layer


def _paint_tiles(samples: _Samples, tile: np.ndarray, num_tiles: int, painted: np.ndarray) -> np.ndarray:
    """Returns u8[num_tiles, h, w, 3]. Texels without a triangle get the colour of the nearest one that has one.

    Args:
      samples: covered texels.
      tile: int[F], tile of each triangle.
      num_tiles: number of tiles.
      painted: f64[N, 3] in [0, 1], colours of the samples.
    """
    image = np.zeros((num_tiles, _TILE, _TILE, 3), np.uint8)
    is_empty = np.ones((num_tiles, _TILE, _TILE), bool)
    # Of several values numpy keeps the last; triangles that hold the texel's centre come last.
    order = np.argsort(~samples.is_small, kind="stable")
    index = (tile[samples.face[order]], samples.row[order], samples.column[order])
    image[index] = np.round(255.0 * np.clip(painted[order], 0.0, 1.0))
    is_empty[index] = False
    for number in range(num_tiles):
        rows, columns = np.asarray(
            distance_transform_edt(is_empty[number], return_distances=False, return_indices=True)
        )
        image[number] = image[number][rows, columns]
    return image
