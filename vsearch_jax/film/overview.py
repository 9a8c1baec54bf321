"""A camera from which a whole scene is seen."""

from __future__ import annotations

import itertools
import math

import jax.numpy as jnp
import mujoco
import numpy as np

from vsearch_jax.scene import Scene
from vsearch_jax.types import Camera

_AZIMUTH, _ELEVATION = math.radians(-38.0), math.radians(14.0)
"""Of the direction from which the scene is seen: that of the scene's main light, so that shadows fall behind."""
_FOVY = math.radians(32.0)
_MARGIN = 0.04
"""Of the picture's width and height, kept free at each edge."""
_TABLE = 0.8
"""Half the edge of the piece of table that is in view, in radii of the view sphere."""


def overview_camera(scene: Scene, qpos: np.ndarray, size: tuple[int, int]) -> Camera:
    """Returns the nearest camera of a fixed direction that sees arm, mount and object whole, and the table below.

    Args:
      scene: the scene.
      qpos: f32[N, nq] rad or m, all the joints that the arm will have.
      size: height and width in pixels of the pictures.
    """
    points = np.concatenate([_corners(scene, qpos), _table(scene)])
    sin_azimuth, cos_azimuth = math.sin(_AZIMUTH), math.cos(_AZIMUTH)
    sin_elevation, cos_elevation = math.sin(_ELEVATION), math.cos(_ELEVATION)
    right = (-sin_azimuth, cos_azimuth, 0.0)
    up = (-sin_elevation * cos_azimuth, -sin_elevation * sin_azimuth, cos_elevation)
    backward = (cos_elevation * cos_azimuth, cos_elevation * sin_azimuth, sin_elevation)
    rotation = np.stack([right, up, backward], axis=-1)
    slope = (1.0 - 2.0 * _MARGIN) * math.tan(0.5 * _FOVY)
    x, y, z = (points @ rotation).T
    (place_x, far_x), (place_y, far_y) = _fit(x, z, slope * size[1] / size[0]), _fit(y, z, slope)
    position = rotation @ np.array([place_x, place_y, max(far_x, far_y)])
    return Camera(jnp.asarray(position, jnp.float32), jnp.asarray(rotation, jnp.float32), jnp.float32(_FOVY))


def _fit(across: np.ndarray, along: np.ndarray, slope: float) -> tuple[float, float]:
    """Returns where across and, at the nearest, how far back a camera sees all points within `slope` of its axis.

    |across - place| <= slope (far - along) for every point: two lines bound `far` from below, and meet at the nearest.
    """
    above, below = np.max(across + slope * along), np.max(slope * along - across)
    return 0.5 * (above - below), 0.5 * (above + below) / slope


def _corners(scene: Scene, qpos: np.ndarray) -> np.ndarray:
    """Returns f64[P, 3] m in world, corners of the boxes around the geoms of arm, mount and object."""
    model, data = scene.mj_model, mujoco.MjData(scene.mj_model)
    geoms = [*scene.arm_geom_ids, *scene.mount_geom_ids, *scene.object_geom_ids]
    signs = np.array(list(itertools.product((-1.0, 1.0), repeat=3)))
    boxes = model.geom_aabb[geoms]
    local = boxes[:, None, :3] + signs[None] * boxes[:, None, 3:]
    points = []
    for joints in qpos:
        data.qpos[:] = joints
        mujoco.mj_kinematics(model, data)
        rotation = data.geom_xmat[geoms].reshape(-1, 3, 3)
        points.append(np.einsum("gij,gpj->gpi", rotation, local) + data.geom_xpos[geoms][:, None])
    return np.concatenate(points).reshape(-1, 3)


def _table(scene: Scene) -> np.ndarray:
    half = _TABLE * scene.radius
    return np.array([(x, y, scene.table_height) for x, y in itertools.product((-half, half), repeat=2)])
