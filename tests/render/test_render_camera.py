"""Cameras of a model against MuJoCo's frusta, cameras from poses and matrices, and batches of cameras."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from jaxlie import SE3, SO3

from oracles.render import forward, on_outline, poses
from vsearch_jax import render
from vsearch_jax.render.cameras import pinhole, pixel_rays

SIZE = (24, 32)
CAMERAS = """
<mujoco><worldbody><geom size=".5"/>
  <camera name="plain" pos="0 0 2" fovy="50"/>
  <camera name="sensor" pos="0 0 2" focal=".01 .012" sensorsize=".008 .006" principal=".001 .0005" resolution="32 24"/>
  <camera name="flat" pos="0 0 2" projection="orthographic"/>
</worldbody></mujoco>
"""
BOX = """
<mujoco><visual><headlight ambient="1 1 1" diffuse="0 0 0" specular="0 0 0"/></visual><worldbody>
  <geom type="box" size=".3 .2 .1"/>
  <camera name="eye" pos="0 0 2" fovy="50"/>
</worldbody></mujoco>
"""


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(CAMERAS)


@pytest.fixture(scope="module")
def data(model: mujoco.MjModel) -> mujoco.MjData:
    return forward(model)


def _frustum(model: mujoco.MjModel, data: mujoco.MjData, name: str) -> mujoco.MjvGLCamera:
    scene, camera = mujoco.MjvScene(model, 100), mujoco.MjvCamera()
    camera.type, camera.fixedcamid = mujoco.mjtCamera.mjCAMERA_FIXED, model.camera(name).id
    mujoco.mjv_updateScene(model, data, mujoco.MjvOption(), None, camera, mujoco.mjtCatBit.mjCAT_ALL, scene)
    return scene.camera[0]


def test_camera_with_a_sensor_equals_mujocos_frustum(model: mujoco.MjModel, data: mujoco.MjData) -> None:
    camera = render.camera(data, model, "sensor", SIZE)
    x, y = (np.asarray(axis).ravel() for axis in pixel_rays(pinhole(camera, SIZE), SIZE))
    frustum = _frustum(model, data, "sensor")
    near = frustum.frustum_near
    half = np.array([x[1] - x[0], y[0] - y[1]]) / 2  # the frustum ends at the edges of the outer pixels
    left = frustum.frustum_center - frustum.frustum_width
    right = frustum.frustum_center + frustum.frustum_width
    np.testing.assert_allclose([x[0] - half[0], x[-1] + half[0]], np.array([left, right]) / near, rtol=1e-4)
    edges = np.array([frustum.frustum_top, frustum.frustum_bottom]) / near
    np.testing.assert_allclose([y[0] + half[1], y[-1] - half[1]], edges, rtol=1e-4)


def test_camera_without_a_sensor_has_its_field_of_view(model: mujoco.MjModel, data: mujoco.MjData) -> None:
    camera = render.camera(data, model, "plain")
    assert camera.intrinsics is None
    frustum = _frustum(model, data, "plain")
    assert np.tan(camera.fovy / 2) == pytest.approx(frustum.frustum_top / frustum.frustum_near, rel=1e-5)


def test_errors_of_cameras_name_the_camera(model: mujoco.MjModel, data: mujoco.MjData) -> None:
    with pytest.raises(render.RenderError, match="'flat' is orthographic"):
        render.camera(data, model, "flat")
    with pytest.raises(render.RenderError, match=r"'sensor' has a sensorsize.*size=\(height, width\)"):
        render.camera(data, model, "sensor")
    with pytest.raises(render.RenderError, match="no camera 'other'; it has: 'plain', 'sensor', 'flat'"):
        render.camera(data, model, "other")


def test_a_camera_without_a_name_is_reached_by_its_number() -> None:
    model = mujoco.MjModel.from_xml_string("""<mujoco><worldbody><geom size=".5"/><camera name="front" pos="0 -2 0"/>
      <camera pos="0 0 2" fovy="50"/></worldbody></mujoco>""")
    data = forward(model)
    np.testing.assert_allclose(render.camera(data, model, 1).position, [0.0, 0.0, 2.0])
    jax.tree.map(np.testing.assert_array_equal, render.camera(data, model, 0), render.camera(data, model, "front"))
    for number in (2, -1):
        with pytest.raises(render.RenderError, match=f"no camera number {number}; it has: 'front', number 1"):
            render.camera(data, model, number)


@pytest.mark.parametrize("fovy", [45, 0.0, float("nan")])
def test_error_of_a_field_of_view_names_the_range(fovy: float) -> None:
    with pytest.raises(render.RenderError, match=r"fovy is .*; allowed: between 0 and pi, in rad"):
        render.camera_from_pose(SE3.identity(), fovy)


def test_camera_from_matrix_equals_camera_from_field_of_view() -> None:
    box = mujoco.MjModel.from_xml_string(BOX)
    frames, scene, size = poses(box, forward(box)), render.compile_scene(box), (48, 64)
    by_angle = render.camera(frames, box, "eye")
    focal = 0.5 * size[0] / np.tan(0.5 * np.deg2rad(50))
    matrix = jnp.array([[focal, 0, (size[1] - 1) / 2], [0, focal, (size[0] - 1) / 2], [0, 0, 1]])
    pose = SE3.from_rotation_and_translation(SO3.identity(), jnp.array([0.0, 0.0, 2.0]))
    by_matrix = render.camera_from_matrix(pose, matrix)
    draw = jax.jit(render.render, static_argnames="size")
    expected = draw(scene, frames, by_angle, size=size)
    image = draw(scene, frames, by_matrix, size=size)
    np.testing.assert_array_equal(image.geom_id, expected.geom_id)
    np.testing.assert_allclose(image.rgb, expected.rgb, atol=1e-5)
    shifted_camera = render.camera_from_matrix(pose, matrix.at[0, 2].add(7.0).at[1, 2].add(-5.0))
    shifted = draw(scene, frames, shifted_camera, size=size)
    np.testing.assert_array_equal(shifted.geom_id, np.roll(expected.geom_id, (-5, 7), axis=(0, 1)))
    supersample = jax.jit(render.supersample, static_argnames=("size", "factor"))
    for camera in (by_angle, by_matrix):
        smooth = supersample(scene, frames, camera, size=size, factor=3)
        np.testing.assert_array_equal(smooth.geom_id, expected.geom_id)
        inside = ~on_outline(np.asarray(expected.geom_id))
        np.testing.assert_allclose(smooth.rgb[inside], expected.rgb[inside], atol=0.02)
        brightness = np.asarray(smooth.rgb).sum(axis=-1)
        is_blended = (brightness > 0.02) & (brightness < 0.9 * brightness.max())
        assert is_blended.sum() > 20  # pixels on the edges
    with pytest.raises(render.RenderError, match="factor is 2"):
        render.supersample(scene, frames, by_angle, size, 2)


def test_cameras_from_a_batch_of_poses(model: mujoco.MjModel, data: mujoco.MjData) -> None:
    scene, frames = render.compile_scene(model), render.poses(data)
    camera_poses = SE3.from_translation(jnp.array([[0.0, 0.0, 2.0], [0.1, 0.0, 3.0]]))
    matrix = np.array([[20.0, 0.0, 15.5], [0.0, 20.0, 11.5], [0.0, 0.0, 1.0]])
    draw = jax.jit(jax.vmap(lambda camera: render.render(scene, frames, camera, SIZE).geom_id))
    by_angle = draw(render.camera_from_pose(camera_poses, fovy=2.0 * np.arctan(12.0 / 20.0)))
    by_matrix = draw(render.camera_from_matrix(camera_poses, matrix))
    assert by_angle.shape == (2, *SIZE) and 0 < (by_angle[0] >= 0).sum() != (by_angle[1] >= 0).sum()
    np.testing.assert_array_equal(by_angle, by_matrix)


@pytest.mark.parametrize("batch_size", [2, 3, 8])
def test_render_batch_equals_vmap(model: mujoco.MjModel, data: mujoco.MjData, batch_size: int) -> None:
    scene, frames = render.compile_scene(model), render.poses(data)
    eye = render.camera(frames, model, "plain")
    cameras = jax.vmap(lambda height: eye.replace(position=eye.position.at[2].set(height)))(
        np.float32([1.5, 2, 3, 4, 5])
    )
    expected = jax.jit(jax.vmap(lambda camera: render.render(scene, frames, camera, SIZE)))(cameras)
    images = jax.jit(lambda c: render.render_batch(scene, frames, c, SIZE, batch_size=batch_size))(cameras)
    assert len(np.unique(np.sum(expected.geom_id >= 0, axis=(1, 2)))) == 5
    jax.tree.map(np.testing.assert_array_equal, images, expected)


def test_error_of_batch_size_names_the_range(model: mujoco.MjModel, data: mujoco.MjData) -> None:
    frames = render.poses(data)
    camera = render.camera(frames, model, "plain")
    with pytest.raises(render.RenderError, match="batch_size is 0; allowed: 1 or more"):
        render.render_batch(render.compile_scene(model), frames, camera, SIZE, batch_size=0)
