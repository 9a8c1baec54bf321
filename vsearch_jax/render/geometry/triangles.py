"""Meshes and height fields as one list of triangles.

The list is made on the host, once for a scene. It stores for each face its corners and, as affine maps of the point on
the face, its smooth normal and its texture coordinates. An affine map that matches the values at the three corners
interpolates them as barycentric coordinates do.

Normals follow MuJoCo's renderer (render_context.c, `mjr_uploadMesh` and `mjr_uploadHField`): smooth over a mesh, flat
on height fields and at sharp edges.
"""

from __future__ import annotations

import flax.struct
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array
from mujoco import mjtGeom

# Cosine. In a mesh without texture coordinates, a vertex normal that deviates further from the face's normal is
# replaced by the face's normal, so that edges stay sharp (`mjr_uploadMesh`).
_MIN_SMOOTH_COSINE = 0.8
# Keeps quotients finite for faces without area.
_TINY = 1e-300

TRIANGLE_TYPES = (int(mjtGeom.mjGEOM_HFIELD), int(mjtGeom.mjGEOM_MESH))


@flax.struct.dataclass
class Triangles:
    """The faces of all visible meshes and height fields. T is the number of faces, M the number of these geoms.

    Faces are sorted by geom. They share no vertices: reading one table in order is cheaper than looking up vertices.
    All coordinates are in the frame of the face's geom.

    Attributes:
      corners: f32[3, 3, T] m; axes are corner, coordinate, face. Corners run counterclockwise as seen from outside.
      surface: f32[24, T]. Rows 0-3: unit normal n and offset d of the face's plane n . p = d. Rows 4-15: the 3 x 4
        affine map from a point to the direction of the smooth normal, row by row. Rows 16-23: the 2 x 4 affine map from
        a point to texture coordinates.
      geom: i32[T], 0 to M - 1, the face's geom, counted from the first geom of the scene that is made of triangles.
      low: f32[M, 3] m, lower corner of the geom's bounding box.
      high: f32[M, 3] m, upper corner of the geom's bounding box.
      radius: f32[M] m, radius of the bounding sphere around the geom's origin.
      is_closed: f32[M], 1 where the faces bound solids and face outwards, else 0. From outside such a geom no back face
        is visible.
      has_texcoord: for each geom, whether its mesh has texture coordinates; static.
    """

    corners: Array
    surface: Array
    geom: Array
    low: Array
    high: Array
    radius: Array
    is_closed: Array
    has_texcoord: tuple[bool, ...] = flax.struct.field(pytree_node=False)


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
    parts = [
        _mesh_faces(model, g) if model.geom_type[g] == mjtGeom.mjGEOM_MESH else _height_field_faces(model, g)
        for g in geoms
    ]
    corners = [part[0] for part in parts]
    surfaces = [_surface_rows(*part) for part in parts]
    counts = [len(c) for c in corners]
    return Triangles(
        corners=_f32(np.concatenate(corners).transpose(1, 2, 0)),
        surface=_f32(np.concatenate(surfaces).T),
        geom=jnp.asarray(np.repeat(np.arange(len(geoms)), counts), dtype=jnp.int32),
        low=_f32(np.stack([c.min(axis=(0, 1)) for c in corners])),
        high=_f32(np.stack([c.max(axis=(0, 1)) for c in corners])),
        radius=_f32(np.array([np.sqrt((c * c).sum(axis=-1).max()) for c in corners])),
        is_closed=_f32(np.array([_is_closed(c) for c in corners])),
        has_texcoord=tuple(part[2] is not None for part in parts),
    )


def _f32(values: np.ndarray) -> Array:
    return jnp.asarray(values, dtype=jnp.float32)


def _mesh_faces(model: mujoco.MjModel, geom: int) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """Returns f64[F, 3, 3] corners, f64[F, 3, 3] vertex normals, and f64[F, 3, 2] texture coordinates or None."""
    mesh = int(model.geom_dataid[geom])
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


def _height_field_faces(model: mujoco.MjModel, geom: int) -> tuple[np.ndarray, np.ndarray, None]:
    """Returns corners and normals as `_mesh_faces` does, of the height field's surface, side walls and bottom."""
    field = int(model.geom_dataid[geom])
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
    corners = np.concatenate(triangles)
    return corners, np.repeat(_flat_normals(corners)[:, None], 3, axis=1), None


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


def _is_closed(corners: np.ndarray) -> bool:
    """Returns whether the faces f64[F, 3, 3] bound solids and face outwards.

    Two conditions must hold. Each edge is used once in each direction. Each connected part has a positive volume.
    """
    vertices, index = np.unique(corners.reshape(-1, 3), axis=0, return_inverse=True)
    faces = index.reshape(-1, 3)
    # Leave out faces with two equal corners.
    faces = faces[np.all(faces != np.roll(faces, 1, axis=1), axis=1)]
    ends = np.concatenate([faces, np.roll(faces, -1, axis=1)]).reshape(2, -1) if len(faces) else np.zeros((2, 0), int)
    start, stop = ends
    forward, backward = start * len(vertices) + stop, stop * len(vertices) + start
    if len(np.unique(forward)) != len(forward) or not np.array_equal(np.sort(forward), np.sort(backward)):
        return False
    part = _connected_parts(start, stop, len(vertices))[faces[:, 0]]
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    volumes = np.bincount(part, weights=np.sum(a * np.cross(b, c), axis=-1))
    return bool(np.all(volumes[np.unique(part)] > 0.0))


def _connected_parts(start: np.ndarray, stop: np.ndarray, count: int) -> np.ndarray:
    """Returns int[count], the connected part of each vertex; edges run from vertices `start` to vertices `stop`."""
    from scipy.sparse import coo_array  # imported here because it takes long, and only scenes with meshes need it
    from scipy.sparse.csgraph import connected_components

    graph = coo_array((np.ones(len(start)), (start, stop)), shape=(count, count))
    return connected_components(graph, directed=False)[1]
