"""Points on the surface of an object, for errors that are measured there; its symmetry in words."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import mujoco
import numpy as np
import scipy.spatial
import trimesh

_GEOM = mujoco.mjtGeom


def surface_points(model: mujoco.MjModel, geom_ids: Sequence[int]) -> np.ndarray:
    """Returns the corners of the convex hull of geoms, f64[P, 3] m in world at `qpos0`.

    The largest distance that a point of the geoms moves between two poses is that of a corner of the hull, because it
    is a convex function of the point. Round shapes are approximated by meshes. A geom without an end (a plane) has no
    points.

    Args:
      model: the compiled model.
      geom_ids: MuJoCo's numbers of the geoms.
    """
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    found = [
        _local_points(model, geom) @ data.geom_xmat[geom].reshape(3, 3).T + data.geom_xpos[geom] for geom in geom_ids
    ]
    points = np.concatenate([np.zeros((0, 3)), *found])
    try:
        return points[scipy.spatial.ConvexHull(points).vertices]
    except (scipy.spatial.QhullError, ValueError):  # flat, or no points
        return points


def _local_points(model: mujoco.MjModel, geom: int) -> np.ndarray:
    """Returns points f64[N, 3] m of a geom in its frame, whose convex hull is about that of the geom."""
    kind, size = _GEOM(model.geom_type[geom]), model.geom_size[geom]
    if kind == _GEOM.mjGEOM_PLANE:
        return np.zeros((0, 3))
    if kind == _GEOM.mjGEOM_MESH:
        mesh = model.geom_dataid[geom]
        start = model.mesh_vertadr[mesh]
        return np.asarray(model.mesh_vert[start : start + model.mesh_vertnum[mesh]], np.float64)
    if kind in (_GEOM.mjGEOM_SPHERE, _GEOM.mjGEOM_ELLIPSOID):
        radii = np.full(3, size[0]) if kind == _GEOM.mjGEOM_SPHERE else size
        return np.asarray(trimesh.creation.icosphere(subdivisions=2).vertices) * radii
    if kind == _GEOM.mjGEOM_CYLINDER:
        return np.asarray(trimesh.creation.cylinder(size[0], 2.0 * size[1]).vertices)
    if kind == _GEOM.mjGEOM_CAPSULE:
        end, offset = trimesh.creation.icosphere(subdivisions=2, radius=size[0]).vertices, np.array([0.0, 0.0, size[1]])
        return np.concatenate([end + offset, end - offset])
    return box_corners(model, geom)  # of a box, or of the box around a height field


def box_corners(model: mujoco.MjModel, geom: int) -> np.ndarray:
    """Returns f64[8, 3] m, the corners of a geom's bounding box in the frame of the geom.

    Args:
      model: the compiled model.
      geom: MuJoCo's number of the geom.
    """
    center, half_sizes = model.geom_aabb[geom, :3], model.geom_aabb[geom, 3:]
    return center + half_sizes * np.array(list(itertools.product((-1.0, 1.0), repeat=3)))


def describe_symmetry(order: int) -> str:
    """Returns a sentence on an object's symmetry and on what it does to the errors; empty without symmetry.

    Args:
      order: number of turns about the vertical that map the object to itself; 1 for none, 0 for any turn.
    """
    if order == 1:
        return ""
    turns = "any turn" if order == 0 else f"each of {order} equal turns"
    return f"The object counts as equal after {turns} about the vertical; errors are those to the nearest equal pose."
