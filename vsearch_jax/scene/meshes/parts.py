"""Divides the triangles of a mesh file into parts of one material each, as MuJoCo's geoms need.

MuJoCo has no colours of vertices or faces. Few plain colours become a part each. More colours, or colours that change
within a triangle, are painted into one texture; see `scene.meshes.painting`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from vsearch_jax.scene.meshes.checks import weld
from vsearch_jax.scene.meshes.painting import paint_texture
from vsearch_jax.scene.meshes.reading import Surface

DEFAULT_RGB = (0.75, 0.55, 0.35)
"""Colour of triangles without a colour."""

_MAX_PLAIN_COLOURS = 16
# Cosine of the angle between face and vertex normal beyond which MuJoCo takes an edge as sharp (`mjr_uploadMesh`).
_MIN_SMOOTH_COSINE = 0.8
_TINY = 1e-300


@dataclass(frozen=True)
class Part:
    """F triangles of one material.

    Attributes:
      corners: f64[F, 3, 3], positions of the corners, in the unit of the file.
      normals: f64[F, 3, 3], unit normals at the corners. None: MuJoCo computes them.
      rgb: f32[3] in [0, 1], the colour, or the factor of the texture.
      image: u8[H, W, 3], the texture, top row first; or None.
      texcoords: f64[F, 3, 2], texture coordinates, v upwards from the bottom row; None without texture.
    """

    corners: np.ndarray
    normals: np.ndarray | None
    rgb: np.ndarray
    image: np.ndarray | None
    texcoords: np.ndarray | None


class _Paint(NamedTuple):
    """The last three attributes of a `Part`."""

    rgb: np.ndarray
    image: np.ndarray | None = None
    texcoords: np.ndarray | None = None


def split_parts(surfaces: list[Surface]) -> list[Part]:
    """Divides surfaces into parts of one material.

    Normals are left to MuJoCo if there is one part, without texture and without normals in the file. Otherwise normals
    that the file does not give are computed by MuJoCo's rule over all surfaces, so that borders of parts stay smooth.

    Args:
      surfaces: all triangles of a file, at least one.

    Returns:
      The parts. Together they have the triangles of the surfaces.
    """
    corners = np.concatenate([surface.corners for surface in surfaces])
    labels, paints = _textured_paints(surfaces)
    is_plain = labels < 0
    if is_plain.any():
        colours = np.concatenate([_colours(surface) for surface in surfaces])[is_plain]
        plain_labels, plain_paints = _plain_paints(corners[is_plain], colours)
        labels[is_plain] = plain_labels + len(paints)
        paints += plain_paints
    is_left_to_mujoco = len(paints) == 1 and is_plain.all() and paints[0].image is None
    if is_left_to_mujoco and all(surface.normals is None for surface in surfaces):
        return [Part(corners, None, *paints[0])]
    normals = _all_normals(surfaces)
    return [Part(corners[labels == i], normals[labels == i], *paint) for i, paint in enumerate(paints)]


def _colours(surface: Surface) -> np.ndarray:
    """Returns f32[F, 3, 3], the colours at the corners."""
    default = np.array(DEFAULT_RGB, np.float32)
    return np.broadcast_to(default, surface.corners.shape) if surface.colours is None else surface.colours


def _textured_paints(surfaces: list[Surface]) -> tuple[np.ndarray, list[_Paint]]:
    """Returns the number of each triangle's texture, int[F], -1 for none; and the textures with their coordinates."""
    groups: dict[tuple[int, bytes], int] = {}
    labels, members = [], []
    for surface in surfaces:
        label = -1
        if surface.image is not None:
            key = (id(surface.image), _colours(surface)[0, 0].tobytes())
            label = groups.setdefault(key, len(groups))
            if label == len(members):
                members.append([])
            members[label].append(surface)
        labels.append(np.full(len(surface.corners), label))
    paints = []
    for group in members:
        texcoords = np.concatenate([surface.texcoords for surface in group])
        paints.append(_Paint(_colours(group[0])[0, 0], _without_alpha(group[0].image), texcoords))
    return np.concatenate(labels), paints


def _without_alpha(image: np.ndarray | None) -> np.ndarray | None:
    return None if image is None else np.ascontiguousarray(image[..., :3])


def _plain_paints(corners: np.ndarray, colours: np.ndarray) -> tuple[np.ndarray, list[_Paint]]:
    """Returns the number of each triangle's paint, int[F], and the paints: plain colours, or one painted texture."""
    if np.array_equal(colours, np.broadcast_to(colours[:, :1], colours.shape)):
        distinct, labels = np.unique(colours[:, 0], axis=0, return_inverse=True)
        if len(distinct) <= _MAX_PLAIN_COLOURS:
            return labels.reshape(-1), [_Paint(rgb) for rgb in distinct]
    image, texcoords = paint_texture(corners, colours)
    return np.zeros(len(corners), int), [_Paint(np.ones(3, np.float32), image, texcoords)]


def _all_normals(surfaces: list[Surface]) -> np.ndarray:
    """Returns f64[F, 3, 3], the normals at the corners of all surfaces."""
    is_missing = np.concatenate([np.full(len(s.corners), s.normals is None) for s in surfaces])
    corners = np.concatenate([surface.corners for surface in surfaces])
    normals = np.concatenate([s.corners if s.normals is None else s.normals for s in surfaces])
    if is_missing.any():
        normals[is_missing] = _smooth_normals(corners[is_missing])
    return normals


def _smooth_normals(corners: np.ndarray) -> np.ndarray:
    """Returns f64[F, 3, 3], unit normals at the corners: means by area over the faces at a point, sharp edges kept."""
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    flat = _unit(cross)[:, None]
    point = weld(corners)[1]
    weight = np.repeat(cross[:, None], 3, axis=1)
    mean = _unit(_sum_at(point, weight))[point]
    # Faces that deviate too far from the mean at a point do not count there.
    is_near = np.sum(mean * flat, axis=-1, keepdims=True) >= _MIN_SMOOTH_COSINE
    mean = _unit(_sum_at(point, weight * is_near))[point]
    is_sharp = np.sum(mean * flat, axis=-1, keepdims=True) < _MIN_SMOOTH_COSINE
    # A face without area has no normal; any unit vector does.
    return np.where(np.any(flat, axis=-1, keepdims=True), np.where(is_sharp, flat, mean), [0.0, 0.0, 1.0])


def _sum_at(index: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Returns f64[V, 3], the sums of `values` f64[F, 3, 3] with an equal `index` int[F, 3]."""
    flat = index.reshape(-1)
    return np.stack([np.bincount(flat, values[..., i].reshape(-1)) for i in range(3)], axis=-1)


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), _TINY)
