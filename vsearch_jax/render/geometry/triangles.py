"""Meshes and height fields as one list of triangles.

The list is made on the host, once for a scene. Geoms that share a mesh or height field share its rows. For each face
the list stores the corners and, as affine maps of the point on the face, the smooth normal and the texture coordinates.
An affine map that matches the values at the three corners interpolates them as barycentric coordinates do.

Normals follow MuJoCo's renderer (render_context.c, `mjr_uploadMesh` and `mjr_uploadHField`): smooth over a mesh, flat
on height fields and at sharp edges.
"""

from __future__ import annotations

from typing import NamedTuple

import flax.struct
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array
from mujoco import mjtGeom

from vsearch_jax.render.geometry.solids import bounds_solids

# Cosine. In a mesh without texture coordinates, a vertex normal that deviates further from the face's normal is
# replaced by the face's normal, so that edges stay sharp (`mjr_uploadMesh`).
_MIN_SMOOTH_COSINE = 0.8
# Keeps quotients finite for faces without area.
_TINY = 1e-300
# Faces whose rows are computed at a time, to bound the memory.
_CHUNK = 2**16
# Rows of `Triangles.surface`, without and with texture coordinates.
NUM_ROWS_WITHOUT_TEXCOORD, NUM_ROWS = 16, 24

TRIANGLE_TYPES = (int(mjtGeom.mjGEOM_HFIELD), int(mjtGeom.mjGEOM_MESH))


@flax.struct.dataclass
class Triangles:
    """The faces of all visible meshes and height fields.

    M is the number of these geoms, T the number of their faces. A is the number of faces of their meshes and height
    fields, each counted once. The T faces are sorted by geom.

    Faces share no vertices: reading one table in order is cheaper than looking up vertices. All coordinates are in the
    frame of the face's geom.

    Attributes:
      corners: f32[3, 3, A] m; axes are corner, coordinate, face. Corners run counterclockwise as seen from outside.
      surface: f32[16 or 24, A]. Rows 0-3: unit normal n and offset d of the face's plane n . p = d. Rows 4-15: the
        3 x 4 affine map from a point to the direction of the smooth normal, row by row. Rows 16-23: the 2 x 4 affine
        map from a point to texture coordinates; left out if no mesh has any.
      geom: i32[T], 0 to M - 1, the face's geom, counted from the first geom of the scene that is made of triangles.
      shift: i32[M], column in `corners` and `surface` of a geom's face, less the face's number among the T faces.
      low: f32[M, 3] m, lower corner of the geom's bounding box.
      high: f32[M, 3] m, upper corner of the geom's bounding box.
      radius: f32[M] m, radius of the bounding sphere around the geom's origin.
      is_closed: f32[M], 1 where the faces bound solids and face outwards, else 0. From outside such a geom no back face
        is visible.
      ranges: for each geom, its first column in `corners` and the last plus 1; static.
      has_texcoord: for each geom, whether its mesh has texture coordinates; static.
    """

    corners: Array
    surface: Array
    geom: Array
    shift: Array
    low: Array
    high: Array
    radius: Array
    is_closed: Array
    ranges: tuple[tuple[int, int], ...] = flax.struct.field(pytree_node=False)
    has_texcoord: tuple[bool, ...] = flax.struct.field(pytree_node=False)

    @property
    def is_shared(self) -> bool:
        """Whether two geoms share a mesh or height field."""
        return len(set(self.ranges)) < len(self.ranges)

    @property
    def corners_of_geoms(self) -> Array:
        """Corners of the T faces of all geoms, f32[3, 3, T] m."""
        if not self.is_shared:
            return self.corners
        return jnp.concatenate([self.corners[:, :, start:stop] for start, stop in self.ranges], axis=2)


class _Asset(NamedTuple):
    """A mesh or height field of F faces: its columns in `Triangles`."""

    corners: np.ndarray
    surface: np.ndarray
    is_closed: bool
    has_texcoord: bool


def compile_triangles(model: mujoco.MjModel, geoms: np.ndarray) -> Triangles | None:
    """Collects the faces of all meshes and height fields into one list of triangles for the renderer.

    Args:
      model: the compiled MuJoCo model.
      geoms: int[M], ids of the M geoms of type mesh or height field that are drawn.

    Returns:
      The triangles, with the geoms in the given order. None if `geoms` is empty.
    """
    if not len(geoms):
        return None
    keys = [(int(model.geom_type[g]), int(model.geom_dataid[g])) for g in geoms]
    assets = {key: _compile_asset(model, *key) for key in dict.fromkeys(keys)}
    counts = {key: asset.corners.shape[2] for key, asset in assets.items()}
    starts = dict(zip(assets, np.cumsum([0, *counts.values()]), strict=False))
    own = [assets[key] for key in keys]
    num_rows = NUM_ROWS if any(asset.has_texcoord for asset in own) else NUM_ROWS_WITHOUT_TEXCOORD
    first_face = np.cumsum([0, *(counts[key] for key in keys)])[:-1]
    return Triangles(
        corners=_f32(np.concatenate([asset.corners for asset in assets.values()], axis=2)),
        surface=_f32(np.concatenate([asset.surface[:num_rows] for asset in assets.values()], axis=1)),
        geom=jnp.asarray(np.repeat(np.arange(len(geoms)), [counts[key] for key in keys]), dtype=jnp.int32),
        shift=jnp.asarray([starts[key] - first for key, first in zip(keys, first_face, strict=True)], dtype=jnp.int32),
        low=_f32(np.stack([asset.corners.min(axis=(0, 2)) for asset in own])),
        high=_f32(np.stack([asset.corners.max(axis=(0, 2)) for asset in own])),
        radius=_f32(np.array([np.sqrt((asset.corners**2).sum(axis=1).max()) for asset in own])),
        is_closed=_f32(np.array([asset.is_closed for asset in own])),
        ranges=tuple((int(starts[key]), int(starts[key] + counts[key])) for key in keys),
        has_texcoord=tuple(asset.has_texcoord for asset in own),
    )


def _compile_asset(model: mujoco.MjModel, kind: int, number: int) -> _Asset:
    """Returns the columns of mesh or height field `number`."""
    is_mesh = kind == mjtGeom.mjGEOM_MESH
    corners, normals, texcoords = _mesh_faces(model, number) if is_mesh else _height_field_faces(model, number)
    surface = np.empty((NUM_ROWS, len(corners)), np.float32)
    for start in range(0, len(corners), _CHUNK):
        part = slice(start, start + _CHUNK)
        own_normals = np.repeat(_flat_normals(corners[part])[:, None], 3, axis=1) if normals is None else normals[part]
        rows = _surface_rows(corners[part], own_normals, None if texcoords is None else texcoords[part])
        surface[:, part] = rows.T
    # A height field is closed by its side walls and its bottom.
    is_closed = bounds_solids(corners) if is_mesh else True
    return _Asset(corners.transpose(1, 2, 0), surface, is_closed, texcoords is not None)


def _f32(values: np.ndarray) -> Array:
    return jnp.asarray(values, dtype=jnp.float32)


def _mesh_faces(model: mujoco.MjModel, mesh: int) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """Returns f64[F, 3, 3] corners, f64[F, 3, 3] vertex normals, and f64[F, 3, 2] texture coordinates or None."""
    first = int(model.mesh_faceadr[mesh])
    faces = slice(first, first + int(model.mesh_facenum[mesh]))
    corners = model.mesh_vert[model.mesh_face[faces] + int(model.mesh_vertadr[mesh])].astype(np.float64)
    normals = model.mesh_normal[model.mesh_facenormal[faces] + int(model.mesh_normaladr[mesh])].astype(np.float64)
    if model.mesh_texcoordadr[mesh] >= 0:
        texcoords = model.mesh_texcoord[model.mesh_facetexcoord[faces] + int(model.mesh_texcoordadr[mesh])]
        return corners, normals, texcoords.astype(np.float64)
    flat = _flat_normals(corners)[:, None]
    is_sharp = np.sum(normals * flat, axis=-1, keepdims=True) < _MIN_SMOOTH_COSINE
    return corners, np.where(is_sharp, flat, normals), None


def _height_field_faces(model: mujoco.MjModel, field: int) -> tuple[np.ndarray, None, None]:
    """Returns corners as `_mesh_faces` does, of the height field's surface, side walls and bottom; it is drawn flat."""
    rows, columns = int(model.hfield_nrow[field]), int(model.hfield_ncol[field])
    x_half, y_half, height, base = model.hfield_size[field]
    start = int(model.hfield_adr[field])
    z = height * model.hfield_data[start : start + rows * columns].reshape(rows, columns)
    x, y = np.meshgrid(np.linspace(-x_half, x_half, columns), np.linspace(-y_half, y_half, rows))
    top = np.stack([x, y, z], axis=-1)
    a, b, c, d = top[:-1, :-1], top[:-1, 1:], top[1:, 1:], top[1:, :-1]
    triangles = [np.stack([a, b, c], axis=2).reshape(-1, 3, 3), np.stack([a, c, d], axis=2).reshape(-1, 3, 3)]
    horizontal = np.array([1.0, 1.0, 0.0])
    for rim in (top[0], top[:, -1], top[-1, ::-1], top[::-1, 0]):  # counterclockwise as seen from above
        foot = rim * horizontal - [0.0, 0.0, base]
        triangles.append(np.stack([foot[:-1], foot[1:], rim[1:]], axis=1))
        triangles.append(np.stack([foot[:-1], rim[1:], rim[:-1]], axis=1))
    a, b, c, d = (top[i] * horizontal - [0.0, 0.0, base] for i in ((0, 0), (0, -1), (-1, -1), (-1, 0)))
    triangles.append(np.array([[a, c, b], [a, d, c]]))
    return np.concatenate(triangles), None, None


def _flat_normals(corners: np.ndarray) -> np.ndarray:
    """Returns f64[F, 3], unit normals of the faces; 0 for faces without area."""
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return cross / np.maximum(np.linalg.norm(cross, axis=-1, keepdims=True), _TINY)


def _surface_rows(corners: np.ndarray, normals: np.ndarray, texcoords: np.ndarray | None) -> np.ndarray:
    """Returns f64[F, 24], the rows of `Triangles.surface`. Missing texture coordinates are 0."""
    flat = _flat_normals(corners)
    offset = np.sum(flat * corners.mean(axis=1), axis=-1, keepdims=True)
    texcoords = np.zeros((len(corners), 3, 2)) if texcoords is None else texcoords
    maps = _affine_maps(corners, flat, normals), _affine_maps(corners, flat, texcoords)
    return np.concatenate([flat, offset, *maps], axis=1)


def _affine_maps(corners: np.ndarray, flat: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Returns affine maps that take the three corners of each face to `values`.

    Args:
      corners: f64[F, 3, 3] m.
      flat: f64[F, 3], unit normals of the faces.
      values: f64[F, 3, C], C values at each corner.

    Returns:
      f64[F, 4 C], row by row the C x 4 matrix of each map.
    """
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    area = np.maximum(np.sum(flat * np.cross(b - a, c - a), axis=-1, keepdims=True), _TINY)
    # Gradients of the barycentric coordinates of b and c. A face without area is never hit, so its values do not count.
    gradient_b, gradient_c = np.cross(flat, a - c) / area, np.cross(flat, b - a) / area
    rise_b, rise_c = values[:, 1] - values[:, 0], values[:, 2] - values[:, 0]
    slope = rise_b[:, :, None] * gradient_b[:, None] + rise_c[:, :, None] * gradient_c[:, None]
    offset = values[:, 0] - np.einsum("fci,fi->fc", slope, a)
    return np.concatenate([slope, offset[:, :, None]], axis=-1).reshape(len(corners), -1)
