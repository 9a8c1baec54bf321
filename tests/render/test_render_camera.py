"""Cameras of a model against the frusta of MuJoCo's own renderer, and what the renderer refuses by name."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from jaxlie import SE3

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


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(CAMERAS)


@pytest.fixture(scope="module")
def data(model) -> mujoco.MjData:
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return data


def _frustum(model, data, name: str) -> mujoco.MjvGLCamera:
    scene, camera = mujoco.MjvScene(model, 100), mujoco.MjvCamera()
    camera.type, camera.fixedcamid = mujoco.mjtCamera.mjCAMERA_FIXED, model.camera(name).id
    mujoco.mjv_updateScene(model, data, mujoco.MjvOption(), None, camera, mujoco.mjtCatBit.mjCAT_ALL, scene)
    return scene.camera[0]


def test_a_sensor_is_seen_through_as_mujocos_renderer_does(model, data):
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


def test_a_plain_camera_has_its_field_of_view(model, data):
    camera = render.camera(data, model, "plain")
    assert camera.intrinsics is None
    frustum = _frustum(model, data, "plain")
    assert np.tan(camera.fovy / 2) == pytest.approx(frustum.frustum_top / frustum.frustum_near, rel=1e-5)


def test_cameras_that_cannot_be_drawn_are_named(model, data):
    with pytest.raises(render.RenderError, match="'flat' is orthographic"):
        render.camera(data, model, "flat")
    with pytest.raises(render.RenderError, match=r"'sensor' has a sensorsize.*size=\(height, width\)"):
        render.camera(data, model, "sensor")
    with pytest.raises(render.RenderError, match="no camera 'other'; it has: plain, sensor, flat"):
        render.camera(data, model, "other")


SOFT = """
<mujoco><worldbody><geom size=".1"/>
  <flexcomp name="cloth" type="grid" count="3 3 1" spacing=".1 .1 .1" dim="2" radius=".01"{look}/>
</worldbody></mujoco>
"""


@pytest.mark.parametrize(("look", "is_drawn"), [("", True), (' rgba="1 1 1 0"', False), (' group="4"', False)])
def test_a_flex_that_would_be_missing_is_refused(look: str, is_drawn: bool):
    model = mujoco.MjModel.from_xml_string(SOFT.format(look=look))
    if is_drawn:
        with pytest.raises(render.RenderError, match=r"flex 'cloth' \(number 0\) cannot be rendered"):
            render.compile_scene(model)
    else:
        assert render.compile_scene(model).geom_ids == (0,)


def test_derivatives_of_colour_and_light_equal_finite_differences(model, data):
    camera, poses = render.camera(data, model, "plain"), render.poses(data)
    scene = render.compile_scene(model)
    lit = scene.replace(specular=scene.specular * 0.5, shininess=scene.shininess * 0.1)

    def brightness(change, name):
        changed = lit.replace(**{name: getattr(lit, name) + change})
        return render.render(changed, poses, camera, SIZE).rgb.sum()

    for name in ("rgb", "specular", "shininess", "emission", "headlight_diffuse", "headlight_ambient"):
        step = np.float32(1.0 if name == "shininess" else 1e-2)
        value = jax.jit(jax.value_and_grad(lambda change, name=name: brightness(change, name)))
        slope = value(np.float32(0.0))[1]
        difference = (value(step)[0] - value(-step)[0]) / (2 * step)
        assert np.abs(difference) > 1e-3, name
        np.testing.assert_allclose(slope, difference, rtol=2e-2, err_msg=name)


@pytest.mark.parametrize("batch_size", [2, 3, 8])
def test_a_batch_drawn_in_parts_is_the_batch(model, data, batch_size):
    scene, frames = render.compile_scene(model), render.poses(data)
    eye = render.camera(frames, model, "plain")
    cameras = jax.vmap(lambda height: eye.replace(position=eye.position.at[2].set(height)))(
        np.float32([1.5, 2, 3, 4, 5])
    )
    whole = jax.jit(jax.vmap(lambda camera: render.render(scene, frames, camera, SIZE)))(cameras)
    parts = jax.jit(lambda c: render.render_batch(scene, frames, c, SIZE, batch_size=batch_size))(cameras)
    assert len(np.unique(np.sum(whole.geom_id >= 0, axis=(1, 2)))) == 5
    jax.tree.map(np.testing.assert_array_equal, parts, whole)


def test_a_batch_of_none_is_refused(model, data):
    frames = render.poses(data)
    with pytest.raises(render.RenderError, match="batch_size is 0; allowed: 1 or more"):
        render.render_batch(
            render.compile_scene(model), frames, render.camera(frames, model, "plain"), SIZE, batch_size=0
        )


def test_a_colour_that_is_not_opaque_is_told_of(caplog):
    text = CAMERAS.replace('<geom size=".5"/>', '<geom name="glass" size=".5" rgba="1 0 0 .4"/>')
    render.compile_scene(mujoco.MjModel.from_xml_string(text))
    assert "drawn as if they were opaque" in caplog.text and "glass" in caplog.text


@pytest.mark.parametrize("size", [(0, 8), (8, 40_000)])
def test_a_size_out_of_range_is_named(model, data, size):
    frames = render.poses(data)
    eye = render.camera(frames, model, "plain")
    with pytest.raises(render.RenderError, match=r"size is \(.*; allowed: height and width from 1 to 32767"):
        render.render(render.compile_scene(model), frames, eye, size)


def test_cameras_at_a_batch_of_poses(model, data):
    scene, frames = render.compile_scene(model), render.poses(data)
    poses = SE3.from_translation(jnp.array([[0.0, 0.0, 2.0], [0.1, 0.0, 3.0]]))
    matrix = np.array([[20.0, 0.0, 15.5], [0.0, 20.0, 11.5], [0.0, 0.0, 1.0]])
    draw = jax.jit(jax.vmap(lambda camera: render.render(scene, frames, camera, SIZE).geom_id))
    by_angle = draw(render.camera_from_pose(poses, fovy=2.0 * np.arctan(12.0 / 20.0)))
    by_matrix = draw(render.camera_from_matrix(poses, matrix))
    assert by_angle.shape == (2, *SIZE) and 0 < (by_angle[0] >= 0).sum() != (by_angle[1] >= 0).sum()
    np.testing.assert_array_equal(by_angle, by_matrix)


@pytest.mark.parametrize("fovy", [45, 0.0, float("nan")])
def test_a_field_of_view_in_degrees_is_named(fovy):
    with pytest.raises(render.RenderError, match=r"fovy is .*; allowed: between 0 and pi, in rad"):
        render.camera_from_pose(SE3.identity(), fovy)
