"""Cameras, and the rays of their pixels."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array
from jaxlie import SE3

from vsearch_jax.render.geometry.rasterizer import Pinhole
from vsearch_jax.render.scene import RenderError
from vsearch_jax.types import Camera


def camera(data: Any, mj_model: mujoco.MjModel, name: str, size: tuple[int, int] | None = None) -> Camera:
    """Returns the model's camera `name` where `data` puts it.

    Args:
      data: mjx.Data, or anything with cam_xpos f32[ncam, 3] m and cam_xmat f32[ncam, 3, 3], camera to world.
      mj_model: the model of `data`; gives the field of view, or the sensor, focal lengths and principal point.
      name: the camera's name.
      size: height and width in pixels of the images; needed for a camera with a sensor only, whose pixels need not be
        square nor its axis central.

    Raises:
      RenderError: the model has no camera of that name, it is orthographic, or it has a sensor and no size is given.
    """
    camera_id = mujoco.mj_name2id(mj_model, mujoco.mjtObj.mjOBJ_CAMERA, name)
    if camera_id < 0:
        names = ", ".join(mj_model.cam(i).name for i in range(mj_model.ncam)) or "none"
        raise RenderError(f"the model has no camera {name!r}; it has: {names}")
    if mj_model.cam_projection[camera_id] != mujoco.mjtProjection.mjPROJ_PERSPECTIVE:
        raise RenderError(f"camera {name!r} is orthographic, which cannot be rendered; make it a perspective camera")
    fovy = jnp.deg2rad(jnp.float32(mj_model.cam_fovy[camera_id]))
    rotation = jnp.asarray(data.cam_xmat[camera_id], dtype=jnp.float32).reshape(3, 3)
    position = jnp.asarray(data.cam_xpos[camera_id], dtype=jnp.float32)
    return Camera(position, rotation, fovy, _intrinsics(mj_model, camera_id, size))


def _intrinsics(mj_model: mujoco.MjModel, camera_id: int, size: tuple[int, int] | None) -> Array | None:
    """Returns f32[4] pixels, or None for a camera without a sensor; see `Camera.intrinsics`."""
    sensor = mj_model.cam_sensorsize[camera_id]
    if not sensor[1] > 0.0:
        return None
    if size is None:
        name = mj_model.cam(camera_id).name
        raise RenderError(f"camera {name!r} has a sensorsize; say for which images: camera(..., size=(height, width))")
    focal, principal = mj_model.cam_intrinsic[camera_id, :2], mj_model.cam_intrinsic[camera_id, 2:]
    pixels = np.array([size[1], size[0]]) / sensor
    center = 0.5 * (np.array([size[1], size[0]]) - 1.0) - principal * pixels
    return jnp.asarray(np.concatenate([focal * pixels, center]), jnp.float32)


def camera_from_pose(T_world_camera: SE3, fovy: Array | float) -> Camera:
    """Returns the camera at a pose, or a batch of them at a batch of poses.

    Args:
      T_world_camera: pose of the camera, which looks along its own -z with +y up; batch axes lead.
      fovy: f32[] or f32[*batch] rad, vertical field of view.

    Raises:
      RenderError: `fovy` is a Python number that is no angle between 0 and pi.
    """
    if isinstance(fovy, (int, float)) and not 0.0 < fovy < np.pi:
        raise RenderError(f"fovy is {fovy:g}; allowed: between 0 and pi, in rad")
    return _at_pose(T_world_camera, jnp.asarray(fovy, jnp.float32), None)


def _at_pose(T_world_camera: SE3, fovy: Array, intrinsics: Array | None) -> Camera:
    batch = T_world_camera.get_batch_axes()
    return Camera(
        position=T_world_camera.translation(),
        rotation=T_world_camera.rotation().as_matrix(),
        fovy=jnp.broadcast_to(fovy, batch),
        intrinsics=None if intrinsics is None else jnp.broadcast_to(intrinsics, (*batch, 4)),
    )


def camera_from_matrix(T_world_camera: SE3, matrix: Array) -> Camera:
    """Returns the camera with a calibrated camera's matrix, or a batch of them at a batch of poses.

    Args:
      T_world_camera: pose of the camera, which looks along its own -z with +y up. OpenCV's looks along +z with +y down:
        turn its pose by pi around its x axis.
      matrix: f32[3, 3] or f32[*batch, 3, 3] pixels, ((fx, 0, cx), (0, fy, cy), (0, 0, 1)), for the size of the images
        that are drawn.
    """
    rows, columns = np.array([0, 1, 0, 1]), np.array([0, 1, 2, 2])
    return _at_pose(T_world_camera, jnp.float32(0.0), matrix[..., rows, columns].astype(jnp.float32))


def magnified(camera: Camera, factor: int) -> Camera:
    """Returns the camera that sees the same in images `factor` times as large."""
    if camera.intrinsics is None:
        return camera
    focal, center = camera.intrinsics[:2], camera.intrinsics[2:]
    intrinsics = jnp.concatenate([factor * focal, factor * (center + 0.5) - 0.5])
    return camera.replace(intrinsics=intrinsics)  # pyright: ignore[reportAttributeAccessIssue] # flax adds it


def pinhole(camera: Camera, size: tuple[int, int]) -> Pinhole:
    """Returns how `camera` maps onto an image of height and width `size`."""
    if camera.intrinsics is not None:
        return Pinhole(*camera.intrinsics)
    height, width = size
    scale = 0.5 * height / jnp.tan(0.5 * camera.fovy)
    center_x, center_y = (jnp.full_like(scale, 0.5 * (count - 1)) for count in (width, height))
    return Pinhole(scale, scale, center_x, center_y)


def pixel_rays(pinhole: Pinhole, size: tuple[int, int]) -> tuple[Array, Array]:
    """Returns the slopes of the rays through the pixels' centres.

    The ray of pixel (row, column) runs along (x, y, -1) in the camera's frame, so a distance along it, in units of that
    vector, is a depth along the optical axis.

    Args:
      pinhole: Pinhole.
      size: height and width in pixels.

    Returns:
      x of each column, f32[1, W], and y of each row, f32[H, 1].
    """
    height, width = size
    columns = jnp.arange(width, dtype=jnp.float32) - pinhole.center_x
    rows = pinhole.center_y - jnp.arange(height, dtype=jnp.float32)
    return (columns / pinhole.scale_x)[None, :], (rows / pinhole.scale_y)[:, None]
