"""A camera that sees the whole scene."""

from __future__ import annotations

import itertools
import math

import jax.numpy as jnp
import mujoco
import numpy as np

from vsearch_jax.scene import Scene
from vsearch_jax.types import Camera

_AZIMUTH, _ELEVATION = math.radians(-38.0), math.radians(14.0)
"""Direction of the camera. It is the direction of the scene's main light, so that shadows fall behind the arm."""
_FOVY = math.radians(32.0)
_MARGIN = 0.04
"""Free share of the image's width and height at each edge."""
_TABLE = 0.8
"""Half the edge of the square of table that is in view, as a multiple of the radius of the view sphere."""


def overview_camera(scene: Scene, qpos: np.ndarray, size: tuple[int, int]) -> Camera:
    """Places the overview camera of a film so that arm, mount, object and some table stay in the image.

    The camera looks in a fixed direction. It is as near as possible.

    Args:
      scene: the scene.
      qpos: f32[N, nq] rad or m, the N joint vectors that the arm takes in the film.
      size: height and width of the images in pixels.

    Returns:
      The camera in world.
    """
    points = np.concatenate([_geom_corners(scene, qpos), _table_corners(scene)])
    sin_azimuth, cos_azimuth = math.sin(_AZIMUTH), math.cos(_AZIMUTH)
    sin_elevation, cos_elevation = math.sin(_ELEVATION), math.cos(_ELEVATION)
    right = (-sin_azimuth, cos_azimuth, 0.0)
    up = (-sin_elevation * cos_azimuth, -sin_elevation * sin_azimuth, cos_elevation)
    backward = (cos_elevation * cos_azimuth, cos_elevation * sin_azimuth, sin_elevation)
    rotation = np.stack([right, up, backward], axis=-1)
    slope = (1.0 - 2.0 * _MARGIN) * math.tan(0.5 * _FOVY)
    x, y, z = (points @ rotation).T
    center_x, back_x = _nearest_fit(x, z, slope * size[1] / size[0])
    center_y, back_y = _nearest_fit(y, z, slope)
    position = rotation @ np.array([center_x, center_y, max(back_x, back_y)])
    return Camera(jnp.asarray(position, jnp.float32), jnp.asarray(rotation, jnp.float32), jnp.float32(_FOVY))


def _nearest_fit(across: np.ndarray, along: np.ndarray, slope: float) -> tuple[float, float]:
    """Returns the position across and along the axis of the nearest camera that sees all points within `slope`.

    Each point needs |across - position_across| <= slope (position_along - along). So two lines bound position_along
    from below. They meet at its least value.
    """
    above, below = np.max(across + slope * along), np.max(slope * along - across)
    return 0.5 * (above - below), 0.5 * (above + below) / slope


def _geom_corners(scene: Scene, qpos: np.ndarray) -> np.ndarray:
    """Returns f64[P, 3] m in world, corners of the bounding boxes of the geoms of arm, mount and object."""
    model, data = scene.mj_model, mujoco.MjData(scene.mj_model)
    geoms = [*scene.arm_geom_ids, *scene.mount_geom_ids, *scene.object_geom_ids]
    signs = np.array(list(itertools.product((-1.0, 1.0), repeat=3)))
    boxes = model.geom_aabb[geoms]
    local = boxes[:, None, :3] + signs[None] * boxes[:, None, 3:]
    points = []
    for configuration in qpos:
        data.qpos[:] = configuration
        mujoco.mj_kinematics(model, data)
        rotation = data.geom_xmat[geoms].reshape(-1, 3, 3)
        points.append(np.einsum("gij,gpj->gpi", rotation, local) + data.geom_xpos[geoms][:, None])
    return np.concatenate(points).reshape(-1, 3)


def _table_corners(scene: Scene) -> np.ndarray:
    """Returns f64[4, 3] m in world, corners of the square of table that is in view."""
    half = _TABLE * scene.radius
    return np.array([(x, y, scene.table_height) for x, y in itertools.product((-half, half), repeat=2)])
