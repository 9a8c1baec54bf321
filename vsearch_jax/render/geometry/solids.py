"""Tells on the host whether the back faces of a mesh can be left out."""

from __future__ import annotations

import numpy as np

# Number of lines along an edge of the grid that is cast through a mesh, and most pairs of line and face's rectangle.
_MIN_LINES, _MAX_LINES, _MAX_PAIRS = 16, 256, 500_000
# Fraction of the mesh's extent. Faces closer than this count as touching.
_TOUCH = 1e-7
# A rotation without symmetry, so that no line runs along an edge of a mesh that is made of squares.
_TILT = np.linalg.qr(np.array([[0.31, -0.72, 0.55], [0.87, 0.21, -0.36], [-0.17, 0.61, 0.83]]))[0]


def bounds_solids(corners: np.ndarray) -> bool:
    """Returns whether a mesh shows no back face to a viewer outside of it.

    Three conditions must hold. Each edge is used once in each direction. Each connected part has a positive volume. On
    lines through the mesh, one never leaves a solid before one enters it. Where a part crosses itself, the last
    condition can fail, and back faces can be seen. It is tested on lines along three axes, at least one for each face
    of average size.

    Args:
      corners: f64[F, 3, 3] m, the corners of the faces, counterclockwise as seen from outside.
    """
    vertices, index = _weld(corners.reshape(-1, 3))
    faces = index.reshape(-1, 3)
    # Leave out faces with two equal corners.
    faces = faces[np.all(faces != np.roll(faces, 1, axis=1), axis=1)]
    if not len(faces):
        return False
    start, stop = np.concatenate([faces, np.roll(faces, -1, axis=1)]).reshape(2, -1)
    forward, backward = np.sort(start * len(vertices) + stop), np.sort(stop * len(vertices) + start)
    if np.any(forward[1:] == forward[:-1]) or not np.array_equal(forward, backward):
        return False
    part = _connected_parts(start, stop, len(vertices))[faces[:, 0]]
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    volumes = np.bincount(part, weights=np.sum(a * np.cross(b, c), axis=-1))
    if not np.all(volumes[np.unique(part)] > 0.0):
        return False
    tilted = vertices @ _TILT
    return all(_enters_before_it_leaves(np.roll(tilted, axis, axis=1), faces) for axis in range(3))


def _weld(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns the distinct points and, for each point, the number of its equal. Faster than `numpy.unique` by rows."""
    order = np.lexsort(points.T)
    is_new = np.concatenate([[True], np.any(points[order[1:]] != points[order[:-1]], axis=1)])
    index = np.empty(len(points), np.int64)
    index[order] = np.cumsum(is_new) - 1
    return points[order[is_new]], index


def _connected_parts(start: np.ndarray, stop: np.ndarray, count: int) -> np.ndarray:
    """Returns int[count], the connected part of each vertex; edges run from vertices `start` to vertices `stop`."""
    from scipy.sparse import coo_array  # imported here because it takes long, and only scenes with meshes need it
    from scipy.sparse.csgraph import connected_components

    graph = coo_array((np.ones(len(start)), (start, stop)), shape=(count, count))
    return connected_components(graph, directed=False)[1]


def _enters_before_it_leaves(vertices: np.ndarray, faces: np.ndarray) -> bool:
    """Returns whether on each of many lines along z the number of entries is never below that of exits.

    Args:
      vertices: f64[V, 3].
      faces: int[F, 3], of a closed mesh.
    """
    low, extent = vertices.min(axis=0), np.ptp(vertices, axis=0).max()
    num_lines = int(np.clip(2.0 * len(faces) ** 0.5, 64, _MAX_LINES))
    while True:
        pixels = (vertices[:, :2] - low[:2]) * (num_lines / extent) - 0.5
        first = np.ceil(pixels[faces].min(axis=1)).astype(np.int64)
        counts = np.maximum(np.floor(pixels[faces].max(axis=1)).astype(np.int64) + 1 - first, 0)
        num_pairs = counts.prod(axis=1)
        if num_pairs.sum() <= _MAX_PAIRS or num_lines <= _MIN_LINES:
            break
        num_lines //= 2
    face = np.repeat(np.arange(len(faces)), num_pairs)
    rank = np.arange(len(face)) - np.repeat(np.cumsum(num_pairs) - num_pairs, num_pairs)
    line = first[face] + np.stack([rank % counts[face, 0], rank // counts[face, 0]], axis=-1)
    sides, areas = _sides(pixels, faces[face], line)
    is_front, is_back = sides.all(axis=1), ~sides.any(axis=1)
    is_hit = np.logical_and(is_front | is_back, areas.sum(axis=1) != 0.0)
    height = np.sum(areas[is_hit] * vertices[faces[face[is_hit]], 2], axis=1) / areas[is_hit].sum(axis=1)
    number = line[is_hit] @ np.array([1, num_lines + 1])
    sign = np.where(is_front, 1, -1)[is_hit]
    # From above; of faces that touch, the entry comes first.
    order = np.lexsort((-sign, -np.round(height / (_TOUCH * extent)), number))
    # Each line leaves the closed mesh as often as it enters, so the sum is 0 at the end of each line.
    return not len(order) or bool(np.cumsum(sign[order]).min() >= 0)


def _sides(pixels: np.ndarray, faces: np.ndarray, line: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns on which side of the three edges of a face a line runs.

    Args:
      pixels: f64[V, 2].
      faces: int[P, 3].
      line: int[P, 2].

    Returns:
      bool[P, 3], and the signed areas f64[P, 3] of the line with the edge opposite of each corner. Two faces that share
      an edge find opposite sides, because the arithmetic of an edge is that of its lower vertex.
    """
    sides, areas = [], []
    for i, j in ((1, 2), (2, 0), (0, 1)):
        is_swapped = faces[:, i] > faces[:, j]
        start = pixels[np.where(is_swapped, faces[:, j], faces[:, i])] - line
        stop = pixels[np.where(is_swapped, faces[:, i], faces[:, j])] - line
        area = start[:, 0] * stop[:, 1] - start[:, 1] * stop[:, 0]
        sides.append((area > 0.0) ^ is_swapped)
        areas.append(np.where(is_swapped, -area, area))
    return np.stack(sides, axis=1), np.stack(areas, axis=1)
