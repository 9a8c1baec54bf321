"""Meshes and height fields as one list of triangles."""

from __future__ import annotations

import flax.struct
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array
from mujoco import mjtGeom

# A vertex normal that leans further from its face than this cosine is replaced by the face's own, where the mesh has
# no texture coordinates (render_context.c, makeMesh): edges of solids stay sharp.
_SMOOTH_COSINE = 0.8

TRIANGLE_TYPES = (int(mjtGeom.mjGEOM_HFIELD), int(mjtGeom.mjGEOM_MESH))


@flax.struct.dataclass
class Triangles:
    """The faces of all visible meshes and height fields; T is their number, M that of these geoms.

    Faces are sorted by geom, and nothing is shared between them: a table that is read once in order is cheaper than
    vertices that are looked up. Coordinates are those of the geom's frame.

    Attributes:
      corners: f32[3, 3, T] m; corner, axis, face; counterclockwise as seen from outside.
      surface: f32[24, T], of each face: the unit normal n and the offset d of its plane n p = d; the 3 x 4 affine map
        from a point to the direction of the smooth normal there, row by row; the 2 x 4 one to texture coordinates.
      geom: i32[T], 0 to M - 1, the face's geom, counted from the scene's first geom that is made of triangles.
      low: f32[M, 3] m, corner of the geom's bounding box.
      high: f32[M, 3] m.
      radius: f32[M] m, of the sphere around the geom's origin that holds it.
      is_closed: f32[M], 1 where the faces are the outer walls of solids, so that from outside no back of a face is
        seen, else 0.
      has_texcoord: for each geom; static.
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
    """Returns the faces of `geoms` (numbers of meshes and height fields), or None if there are none."""
    if not len(geoms):
        return None
    parts = [_mesh(model, g) if model.geom_type[g] == mjtGeom.mjGEOM_MESH else _height_field(model, g) for g in geoms]
    corners = [part[0] for part in parts]
    surfaces = [_surface(*part) for part in parts]
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


def _mesh(model: mujoco.MjModel, geom: int) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """Returns f64[F, 3, 3] corners, f64[F, 3, 3] their normals, and f64[F, 3, 2] texture coordinates or None."""
    mesh = int(model.geom_dataid[geom])
    first = int(model.mesh_faceadr[mesh])
    faces = slice(first, first + int(model.mesh_facenum[mesh]))
    corners = model.mesh_vert[model.mesh_face[faces] + int(model.mesh_vertadr[mesh])].astype(np.float64)
    normals = model.mesh_normal[model.mesh_facenormal[faces] + int(model.mesh_normaladr[mesh])].astype(np.float64)
    if model.mesh_texcoordadr[mesh] >= 0:
        texcoords = model.mesh_texcoord[model.mesh_facetexcoord[faces] + int(model.mesh_texcoordadr[mesh])]
        return corners, normals, texcoords.astype(np.float64)
    flat = _flat_normals(corners)[:, None]
    is_sharp = np.sum(normals * flat, axis=-1, keepdims=True) < _SMOOTH_COSINE
    return corners, np.where(is_sharp, flat, normals), None


def _height_field(model: mujoco.MjModel, geom: int) -> tuple[np.ndarray, np.ndarray, None]:
    """Returns corners and normals as `_mesh` does: of the surface, the walls below its rim, and the bottom."""
    field = int(model.geom_dataid[geom])
    rows, columns = int(model.hfield_nrow[field]), int(model.hfield_ncol[field])
    x_half, y_half, height, base = model.hfield_size[field]
    start = int(model.hfield_adr[field])
    z = height * model.hfield_data[start : start + rows * columns].reshape(rows, columns)
    x, y = np.meshgrid(np.linspace(-x_half, x_half, columns), np.linspace(-y_half, y_half, rows))
    top = np.stack([x, y, z], axis=-1)
    a, b, c, d = top[:-1, :-1], top[:-1, 1:], top[1:, 1:], top[1:, :-1]
    triangles = [np.stack([a, b, c], axis=2).reshape(-1, 3, 3), np.stack([a, c, d], axis=2).reshape(-1, 3, 3)]
    floor = np.array([1.0, 1.0, 0.0])
    for rim in (top[0], top[:, -1], top[-1, ::-1], top[::-1, 0]):  # counterclockwise as seen from above
        foot = rim * floor - [0.0, 0.0, base]
        triangles.append(np.stack([foot[:-1], foot[1:], rim[1:]], axis=1))
        triangles.append(np.stack([foot[:-1], rim[1:], rim[:-1]], axis=1))
    a, b, c, d = (top[i] * floor - [0.0, 0.0, base] for i in ((0, 0), (0, -1), (-1, -1), (-1, 0)))
    triangles.append(np.array([[a, c, b], [a, d, c]]))
    corners = np.concatenate(triangles)
    return corners, np.repeat(_flat_normals(corners)[:, None], 3, axis=1), None


def _flat_normals(corners: np.ndarray) -> np.ndarray:
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return cross / np.maximum(np.linalg.norm(cross, axis=-1, keepdims=True), 1e-300)


def _surface(corners: np.ndarray, normals: np.ndarray, texcoords: np.ndarray | None) -> np.ndarray:
    """Returns f64[F, 24], the rows of `Triangles.surface`."""
    flat = _flat_normals(corners)
    offset = np.sum(flat * corners.mean(axis=1), axis=-1, keepdims=True)
    texcoords = np.zeros((len(corners), 3, 2)) if texcoords is None else texcoords
    return np.concatenate([flat, offset, _affine(corners, flat, normals), _affine(corners, flat, texcoords)], axis=1)


def _affine(corners: np.ndarray, flat: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Returns f64[F, 4 C], row by row the maps that take the three corners of a face to `values` f64[F, 3, C]."""
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    area = np.maximum(np.sum(flat * np.cross(b - a, c - a), axis=-1, keepdims=True), 1e-300)
    # Gradients of the second and third barycentric coordinate; a face without area is never hit.
    second, third = np.cross(flat, a - c) / area, np.cross(flat, b - a) / area
    rise_b, rise_c = values[:, 1] - values[:, 0], values[:, 2] - values[:, 0]
    slope = rise_b[:, :, None] * second[:, None] + rise_c[:, :, None] * third[:, None]
    offset = values[:, 0] - np.einsum("fci,fi->fc", slope, a)
    return np.concatenate([slope, offset[:, :, None]], axis=-1).reshape(len(corners), -1)


def _is_closed(corners: np.ndarray) -> bool:
    """Returns whether each edge is crossed once in either sense, and each connected part turns its faces outwards."""
    vertices, index = np.unique(corners.reshape(-1, 3), axis=0, return_inverse=True)
    faces = index.reshape(-1, 3)
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
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    graph = coo_array((np.ones(len(start)), (start, stop)), shape=(count, count))
    return connected_components(graph, directed=False)[1]
