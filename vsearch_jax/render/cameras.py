"""Cameras of a model, of a pose, of a calibration; and the rays through their pixels."""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array
from jaxlie import SE3

from vsearch_jax.render.errors import RenderError
from vsearch_jax.render.geometry.projection import Pinhole
from vsearch_jax.render.mj_poses import CameraPoses
from vsearch_jax.types import Camera


def camera(data: CameraPoses, mj_model: mujoco.MjModel, name: str | int, size: tuple[int, int] | None = None) -> Camera:
    """Returns a camera of a MuJoCo model, at the pose that `data` holds for it. All of MuJoCo's camera modes work.

    Args:
      data: poses of the model's ncam cameras: `mjx.Data`, `Poses`, or any object with the positions cam_xpos
        f32[ncam, 3] m in world and the rotations cam_xmat f32[ncam, 3, 3], camera to world.
      mj_model: model of `data`. It gives the field of view, or the sensor size, focal lengths and principal point.
      name: name of the camera in the model, or its number from 0, which also reaches a camera without a name.
      size: height and width of the images in pixels. Needed only for a camera with a `sensorsize`. Such a camera may
        have pixels that are not square and an optical axis that is not central.

    Returns:
      The camera in the world frame, of f32 arrays without batch axes.

    Raises:
      RenderError: the model has no camera of this name or number, the camera is orthographic, or it has a sensor and
        `size` is None.
    """
    camera_id = _camera_id(mj_model, name)
    if mj_model.cam_projection[camera_id] != mujoco.mjtProjection.mjPROJ_PERSPECTIVE:
        raise RenderError(f"camera {name!r} is orthographic, which cannot be rendered; make it a perspective camera")
    fovy = jnp.deg2rad(jnp.float32(mj_model.cam_fovy[camera_id]))
    rotation = jnp.asarray(data.cam_xmat[camera_id], dtype=jnp.float32).reshape(3, 3)
    position = jnp.asarray(data.cam_xpos[camera_id], dtype=jnp.float32)
    return Camera(position, rotation, fovy, _sensor_intrinsics(mj_model, camera_id, size))


def _camera_id(mj_model: mujoco.MjModel, name: str | int) -> int:
    is_name = isinstance(name, str)
    camera_id = mujoco.mj_name2id(mj_model, mujoco.mjtObj.mjOBJ_CAMERA, name) if is_name else int(name)
    if not 0 <= camera_id < mj_model.ncam:
        labels = [repr(mj_model.cam(i).name) if mj_model.cam(i).name else f"number {i}" for i in range(mj_model.ncam)]
        request = repr(name) if is_name else f"number {name}"
        raise RenderError(f"the model has no camera {request}; it has: {', '.join(labels) or 'none'}")
    return camera_id


def _sensor_intrinsics(mj_model: mujoco.MjModel, camera_id: int, size: tuple[int, int] | None) -> Array | None:
    """Returns `Camera.intrinsics`, f32[4] pixels, or None for a camera without a sensor."""
    sensor = mj_model.cam_sensorsize[camera_id]
    if not sensor[1] > 0.0:
        return None
    if size is None:
        name = mj_model.cam(camera_id).name
        raise RenderError(
            f"camera {name!r} has a sensorsize, so it needs the image size: call camera(..., size=(height, width))"
        )
    focal, principal = mj_model.cam_intrinsic[camera_id, :2], mj_model.cam_intrinsic[camera_id, 2:]
    pixels_per_meter = np.array([size[1], size[0]]) / sensor
    center = 0.5 * (np.array([size[1], size[0]]) - 1.0) - principal * pixels_per_meter
    return jnp.asarray(np.concatenate([focal * pixels_per_meter, center]), jnp.float32)


def camera_from_pose(T_world_camera: SE3, fovy: Array | float) -> Camera:
    """Returns a camera with a given pose and field of view. A batch of poses gives a batch of cameras.

    Args:
      T_world_camera: pose of the camera in world. The camera looks along its own -z axis with +y up. Batch axes lead.
      fovy: f32[] or f32[*batch] rad, vertical field of view.

    Raises:
      RenderError: `fovy` is a Python number outside (0, pi). A traced array is not checked.
    """
    if isinstance(fovy, (int, float)) and not 0.0 < fovy < np.pi:
        raise RenderError(f"fovy is {fovy:g}; allowed: between 0 and pi, in rad")
    return _camera_at(T_world_camera, jnp.asarray(fovy, jnp.float32), None)


def camera_from_matrix(T_world_camera: SE3, matrix: Array) -> Camera:
    """Returns a camera with a given pose and a calibrated camera matrix. A batch of poses gives a batch of cameras.

    Args:
      T_world_camera: pose of the camera in world. The camera looks along its own -z axis with +y up. Batch axes lead.
        An OpenCV camera looks along +z with +y down: rotate the OpenCV pose by pi about the camera's x axis.
      matrix: f32[3, 3] or f32[*batch, 3, 3] pixels, ((fx, 0, cx), (0, fy, cy), (0, 0, 1)): focal lengths fx and fy,
        image centre (cx, cy). The centre of the first pixel is (0, 0). The matrix holds for one image size: render
        images of this size.
    """
    rows, columns = np.array([0, 1, 0, 1]), np.array([0, 1, 2, 2])
    return _camera_at(T_world_camera, jnp.float32(0.0), matrix[..., rows, columns].astype(jnp.float32))


def _camera_at(T_world_camera: SE3, fovy: Array, intrinsics: Array | None) -> Camera:
    batch = T_world_camera.get_batch_axes()
    return Camera(
        position=T_world_camera.translation(),
        rotation=T_world_camera.rotation().as_matrix(),
        fovy=jnp.broadcast_to(fovy, batch),
        intrinsics=None if intrinsics is None else jnp.broadcast_to(intrinsics, (*batch, 4)),
    )


def scale_resolution(camera: Camera, factor: int) -> Camera:
    """Returns the camera for images with `factor` times as many rows and columns. The field of view stays the same.

    Args:
      camera: the camera for the smaller images.
      factor: ratio of the image sizes, 1 or more; static.
    """
    if camera.intrinsics is None:
        return camera
    focal, center = camera.intrinsics[:2], camera.intrinsics[2:]
    intrinsics = jnp.concatenate([factor * focal, factor * (center + 0.5) - 0.5])
    return dataclasses.replace(camera, intrinsics=intrinsics)


def pinhole(camera: Camera, size: tuple[int, int]) -> Pinhole:
    """Returns the mapping from points in the camera's frame to pixels of the image.

    Args:
      camera: the camera; only its field of view or calibration is read.
      size: height and width of the image in pixels, static.
    """
    if camera.intrinsics is not None:
        return Pinhole(*camera.intrinsics)
    height, width = size
    scale = 0.5 * height / jnp.tan(0.5 * camera.fovy)
    center_x, center_y = (jnp.full_like(scale, 0.5 * (count - 1)) for count in (width, height))
    return Pinhole(scale, scale, center_x, center_y)


def pixel_rays(pinhole: Pinhole, size: tuple[int, int]) -> tuple[Array, Array]:
    """Returns the direction of the camera ray through the centre of each pixel, as slopes x and y.

    The ray of pixel (row, column) has the direction (x, y, -1) in the camera's frame. A distance along the ray, in
    units of this vector, is therefore a depth along the optical axis.

    Args:
      pinhole: mapping from the camera's frame to pixels, from `pinhole`.
      size: height H and width W of the image in pixels, static.

    Returns:
      Slope x of each column, f32[1, W], and slope y of each row, f32[H, 1].
    """
    height, width = size
    columns = jnp.arange(width, dtype=jnp.float32) - pinhole.center_x
    rows = pinhole.center_y - jnp.arange(height, dtype=jnp.float32)
    return (columns / pinhole.scale_x)[None, :], (rows / pinhole.scale_y)[:, None]
