"""Geoms as convex solids: MuJoCo's own collision shapes.

A solid is the convex hull of points, plus an ellipsoid, plus a ball (Minkowski sums). One point and a ball make a
sphere, two points and a flat ellipsoid a cylinder. The points of a mesh are the vertices of its convex hull.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax.numpy as jnp
import mujoco
import numpy as np
import trimesh
from jax import Array
from scipy.spatial import ConvexHull

from vsearch_jax.robot.collision.support import BLOCK, Side
from vsearch_jax.scene import box_corners

SPHERE = int(mujoco.mjtGeom.mjGEOM_SPHERE)
CAPSULE = int(mujoco.mjtGeom.mjGEOM_CAPSULE)
ELLIPSOID = int(mujoco.mjtGeom.mjGEOM_ELLIPSOID)
CYLINDER = int(mujoco.mjtGeom.mjGEOM_CYLINDER)
MESH = int(mujoco.mjtGeom.mjGEOM_MESH)
MAX_VERTICES = 1024
"""A mesh whose hull has more vertices is replaced by the hull of this many, plus a ball that covers the others."""
NUM_COARSE_VERTICES = 64
"""Vertices of the coarse hull, on which the search for a separating direction begins."""


class Solid(NamedTuple):
    """A convex solid in the frame of its geom.

    Attributes:
      points: f64[K, 3] m, points whose convex hull is the core of the solid.
      coarse: f64[L, 3] m, a few of the points whose hull is nearly as large.
      radii: f64[3] m, radii along x, y and z of the ellipsoid that is added to the core; 0 for none.
      ball: m, radius of the ball that is added; 0 for none.
    """

    points: np.ndarray
    coarse: np.ndarray
    radii: np.ndarray
    ball: float


def build_side(solids: Sequence[Solid]) -> Side:
    """Puts solids, one for each pair, into arrays that `convex_distances` reads."""
    coarse, points = (
        _stack_points(solids, lambda solid: solid.coarse),
        _stack_points(solids, lambda solid: solid.points),
    )
    radii = np.stack([solid.radii for solid in solids], axis=-1)
    return Side(
        points=points,
        coarse=coarse if coarse.shape[0] < points.shape[0] else None,
        center=jnp.asarray(np.stack([solid.points.mean(axis=0) for solid in solids], axis=-1), jnp.float32),
        bound=jnp.asarray([np.linalg.norm(solid.points, axis=1).max() for solid in solids], jnp.float32),
        radii=jnp.asarray(radii, jnp.float32) if radii.any() else None,
        ball=jnp.asarray([solid.ball for solid in solids], jnp.float32),
    )


def _stack_points(solids: Sequence[Solid], points_of: Callable[[Solid], np.ndarray]) -> Array:
    """Returns f32[K, 3, P] m. The last point of a solid is repeated; more than BLOCK points are whole blocks."""
    each = [points_of(solid) for solid in solids]
    count = max(len(points) for points in each)
    count = count if count <= BLOCK else -(-count // BLOCK) * BLOCK
    padded = [np.concatenate([points, np.repeat(points[-1:], count - len(points), axis=0)]) for points in each]
    return jnp.asarray(np.stack(padded, axis=-1), jnp.float32)


def convex_solid(model: mujoco.MjModel, geom: int, is_box: bool = False) -> Solid:
    """Converts a geom into a convex solid that contains it.

    The solid equals the shape that MuJoCo collides, the convex hull of a mesh included. A height field counts as its
    bounding box.

    Args:
      model: the compiled model.
      geom: MuJoCo's number of the geom, which is no plane.
      is_box: whether a mesh counts as its bounding box, too.
    """
    kind, size = int(model.geom_type[geom]), model.geom_size[geom].astype(float)
    if kind == MESH and not is_box:
        return _mesh_solid(hull_vertices(model, int(model.geom_dataid[geom])).tobytes())
    tips = np.array([[0.0, 0.0, -size[1]], [0.0, 0.0, size[1]]])
    if kind == SPHERE:
        return _small_solid(np.zeros((1, 3)), ball=float(size[0]))
    if kind == CAPSULE:
        return _small_solid(tips, ball=float(size[0]))
    if kind == CYLINDER:
        return _small_solid(tips, radii=np.array([size[0], size[0], 0.0]))
    if kind == ELLIPSOID:
        return _small_solid(np.zeros((1, 3)), radii=size)
    return _small_solid(box_corners(model, geom))


def hull_vertices(model: mujoco.MjModel, mesh: int) -> np.ndarray:
    """Returns f64[V, 3] m, vertices of the convex hull that MuJoCo collides, in the frame of the geoms of a mesh.

    Args:
      model: the compiled model.
      mesh: MuJoCo's number of the mesh.
    """
    start, count = int(model.mesh_vertadr[mesh]), int(model.mesh_vertnum[mesh])
    vertices = model.mesh_vert[start : start + count].astype(float)
    address = int(model.mesh_graphadr[mesh])
    if address < 0:
        return vertices[ConvexHull(vertices).vertices]
    # MuJoCo's manual, mjModel.mesh_graph: counts of vertices and faces, edge addresses, then the vertices' numbers.
    num_vertices = int(model.mesh_graph[address])
    first = address + 2 + num_vertices
    return vertices[model.mesh_graph[first : first + num_vertices]]


def _small_solid(points: np.ndarray, radii: np.ndarray | None = None, ball: float = 0.0) -> Solid:
    return Solid(points, points, np.zeros(3) if radii is None else radii, ball)


@functools.lru_cache(maxsize=256)  # The large meshes take seconds, and a scene's pairs are built more than once.
def _mesh_solid(vertex_bytes: bytes) -> Solid:
    """Returns the convex hull of vertices as a solid; `vertex_bytes` are the bytes of f64[V, 3] m."""
    vertices = np.frombuffer(vertex_bytes).reshape(-1, 3)
    is_kept_whole = len(vertices) <= MAX_VERTICES
    order = _order_by_importance(vertices, NUM_COARSE_VERTICES if is_kept_whole else MAX_VERTICES)
    coarse = vertices[order[:NUM_COARSE_VERTICES]]
    if is_kept_whole:
        return Solid(vertices, coarse, np.zeros(3), 0.0)
    points, left_out = vertices[order], np.delete(vertices, order, axis=0)
    return Solid(points, coarse, np.zeros(3), _max_distance(left_out, points))


def _order_by_importance(vertices: np.ndarray, limit: int) -> np.ndarray:
    """Returns i64[K], numbers of at most `limit` vertices; the hull of the first ones is always nearly the whole hull.

    Each round adds, for every face of the hull so far, the vertex farthest outside it (as quickhull does).
    """
    directions = np.array(list(itertools.product((-1.0, 0.0, 1.0), repeat=3)))
    extremes = np.argmax(vertices @ directions.T, axis=0)
    order = list(dict.fromkeys(int(i) for i in extremes))
    is_in_order = np.zeros(len(vertices), dtype=bool)
    while len(order) < min(limit, len(vertices)):
        is_in_order[order] = True
        heights = _heights_above_faces(vertices, vertices[order])
        highest = np.unique(np.argmax(heights, axis=0)[heights.max(axis=0) > 1e-9])
        new = highest[~is_in_order[highest]]
        if new.size == 0:
            break
        new = new[np.argsort(-heights[new].max(axis=1), kind="stable")][: max(1, len(new) // 2)]
        order += new.tolist()
    rest = np.setdiff1d(np.arange(len(vertices)), order)
    return np.array([*order, *rest.tolist()][:limit])


def _heights_above_faces(points: np.ndarray, vertices: np.ndarray) -> np.ndarray:
    """Returns f64[N, F] m, signed heights of points f64[N, 3] above the F faces of the hull of `vertices`."""
    equations = ConvexHull(vertices).equations
    return points @ equations[:, :3].T + equations[:, 3]


def _max_distance(points: np.ndarray, vertices: np.ndarray) -> float:
    """Returns the largest distance in m of `points` (f64[N, 3] m) from the convex hull of `vertices`."""
    if len(points) == 0:
        return 0.0
    hull = ConvexHull(vertices)
    triangles, largest = vertices[hull.simplices], 0.0
    for point in points[_heights_above_faces(points, vertices).max(axis=1) > 1e-9]:
        nearest = trimesh.triangles.closest_point(triangles, np.repeat(point[None], len(triangles), axis=0))
        largest = max(largest, float(np.linalg.norm(nearest - point, axis=1).min()))
    return largest
