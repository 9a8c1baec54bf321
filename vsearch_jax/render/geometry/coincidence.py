"""Finds geoms that lie in the same place, such as a visual geom and its collision geom."""

from __future__ import annotations

import mujoco
import numpy as np
from mujoco import mjtGeom

# m, and units of a rotation matrix. Geoms that differ by less than this are in the same place.
_TOLERANCE = 1e-6


def hidden_geoms(model: mujoco.MjModel, geoms: np.ndarray, alpha: np.ndarray) -> np.ndarray:
    """Returns the ids of the geoms that another geom of the same shape in the same place hides.

    Two geoms are in the same place if they have the same type, size, mesh and pose on bodies that cannot move against
    each other. Of such geoms one is drawn: an opaque one before a translucent one, then the one of the higher group,
    then the one of the higher id, which OpenGL draws last.

    Args:
      model: the compiled MuJoCo model.
      geoms: int[G], ids of the visible geoms.
      alpha: f32[ngeom], alpha of each geom's colour.
    """
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    keys = np.stack([_carriers(model)[model.geom_bodyid], model.geom_type], axis=1)
    is_sphere = (model.geom_type == mjtGeom.mjGEOM_SPHERE)[:, None]
    places = np.concatenate([data.geom_xpos, model.geom_size, np.where(is_sphere, 0.0, data.geom_xmat)], axis=1)
    ranked = geoms[np.lexsort((geoms, model.geom_group[geoms], alpha[geoms] >= 1.0))[::-1]]
    hidden = []
    for rank, geom in enumerate(ranked):
        above = ranked[:rank]
        is_same = np.all(keys[above] == keys[geom], axis=1)
        above = above[is_same]
        above = above[np.all(np.abs(places[above] - places[geom]) < _TOLERANCE, axis=1)]
        if any(_has_same_surface(model, int(geom), int(other)) for other in above):
            hidden.append(geom)
    return np.array(hidden, dtype=np.int64)


def _carriers(model: mujoco.MjModel) -> np.ndarray:
    """Returns int[B], for each body the body that moves it: itself or the nearest above with a joint or mocap; or 0."""
    carriers = np.arange(model.nbody)
    for body in range(1, model.nbody):
        if model.body_jntnum[body] == 0 and model.body_mocapid[body] < 0:
            carriers[body] = carriers[model.body_parentid[body]]
    return carriers


def _has_same_surface(model: mujoco.MjModel, geom: int, other: int) -> bool:
    """Returns whether two geoms of the same type have the same mesh or height field, or none."""
    first, second = (int(model.geom_dataid[g]) for g in (geom, other))
    if first == second:
        return True
    if model.geom_type[geom] != mjtGeom.mjGEOM_MESH or model.mesh_facenum[first] != model.mesh_facenum[second]:
        return False
    corners = []
    for mesh in (first, second):
        start = model.mesh_faceadr[mesh]
        faces = model.mesh_face[start : start + model.mesh_facenum[mesh]] + model.mesh_vertadr[mesh]
        corners.append(model.mesh_vert[faces])
    return bool(np.all(np.abs(corners[0] - corners[1]) < _TOLERANCE))
