"""Whole images against C MuJoCo's `mj_multiRay`, and the arguments of `render` and `compile_scene`."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from oracles.render import MAX_GEOMS, cast_image, forward, on_outline, poses, random_scene
from vsearch_jax import render
from vsearch_jax.geometry import view_pose
from vsearch_jax.types import View

# After the Newton step, the depth has the rounding error of an f32 point a few metres from the origin.
DEPTH_TOLERANCE = 2e-6
SIZE = (48, 64)
SEEDS = st.integers(0, 2**31)
SMALL = """
<mujoco>
  <asset><material name="red" rgba="1 0 0 1"/></asset>
  <worldbody>
    <light name="sun" type="directional" dir="0 0 -1"/>
    <geom name="floor" type="plane" size="1 1 1" pos="0 0 -.5"/>
    <geom name="ball" type="sphere" size=".2" material="red"/>
    <geom name="transparent" type="sphere" size=".4" rgba="1 1 1 0"/>
    <geom name="shell" type="sphere" size=".3" group="3"/>
    <camera name="eye" pos="0 0 2" fovy="70"/>
    {extra}
  </worldbody>
</mujoco>
"""

_render = jax.jit(render.render, static_argnames="size")


def _small(extra: str = "") -> tuple[mujoco.MjModel, mujoco.MjData]:
    model = mujoco.MjModel.from_xml_string(SMALL.format(extra=extra))
    return model, forward(model)


@given(seed=SEEDS)
@settings(max_examples=15)
def test_image_equals_mj_multi_ray(seed: int) -> None:
    _assert_equals_mj_multi_ray(random_scene(np.random.default_rng(seed)))


@given(seed=SEEDS)
@settings(max_examples=10)
def test_image_with_meshes_equals_mj_multi_ray(seed: int) -> None:
    _assert_equals_mj_multi_ray(random_scene(np.random.default_rng(seed), num_geoms=10, num_meshes=6))


@pytest.mark.slow
@given(seed=SEEDS, num_geoms=st.sampled_from((0, 5, 15, 25)), num_meshes=st.sampled_from((0, 1, 4, 12)))
@settings(max_examples=250)
def test_many_images_equal_mj_multi_ray(seed: int, num_geoms: int, num_meshes: int) -> None:
    model = random_scene(np.random.default_rng(seed), num_geoms=num_geoms, num_meshes=num_meshes)
    assert model.ngeom <= MAX_GEOMS
    _assert_equals_mj_multi_ray(model)


def _assert_equals_mj_multi_ray(model: mujoco.MjModel) -> None:
    data = forward(model)
    depth, ids = cast_image(model, data, 0, SIZE)
    frames = poses(model, data)
    image = _render(render.compile_scene(model), frames, render.camera(frames, model, "eye"), size=SIZE)
    is_same = np.asarray(image.geom_id) == ids
    assert is_same.mean() >= 0.999
    assert on_outline(ids)[~is_same].all()
    is_hit = is_same & (ids >= 0)
    # f32 cannot resolve the depth of a grazing ray. Such pixels are next to outlines.
    error = np.abs(np.asarray(image.depth)[is_hit] / depth[is_hit] - 1.0)
    assert np.median(error) < DEPTH_TOLERANCE
    assert (error[~on_outline(ids)[is_hit]] < 1e-4).all()
    assert np.isinf(np.asarray(image.depth)[ids < 0]).all()
    assert np.all((np.asarray(image.rgb) >= 0.0) & (np.asarray(image.rgb) <= 1.0))


def test_camera_inside_a_solid_sees_its_wall() -> None:
    model = mujoco.MjModel.from_xml_string(
        '<mujoco><worldbody><geom type="box" size=".5 .4 .3"/><geom type="capsule" size=".7 .2"/>'
        '<camera name="eye" pos=".1 .1 .1"/></worldbody></mujoco>'
    )
    data = forward(model)
    depth, ids = cast_image(model, data, 0, SIZE)
    frames = poses(model, data)
    image = _render(render.compile_scene(model), frames, render.camera(frames, model, "eye"), size=SIZE)
    np.testing.assert_array_equal(image.geom_id, ids)
    np.testing.assert_allclose(image.depth, depth, rtol=1e-5)
    assert np.asarray(image.rgb).min() > 0.1  # the headlight lights the wall as from outside


def test_alpha_geom_groups_background_and_silhouette() -> None:
    model, data = _small()
    frames = poses(model, data)
    eye = render.camera(frames, model, "eye")
    scene = render.compile_scene(model)
    image = _render(scene.replace(background=jnp.array([0.0, 0.25, 1.0])), frames, eye, size=(33, 33))
    assert set(np.unique(image.geom_id)) == {-1, 0, 1}
    np.testing.assert_array_equal(image.rgb[0, 0], np.array([0.0, 0.25, 1.0], np.float32))
    assert np.isinf(image.depth[0, 0])
    np.testing.assert_array_equal(render.silhouette(image, (1,)), image.geom_id == 1)
    np.testing.assert_array_equal(render.silhouette(image, (0, 1)), image.geom_id >= 0)
    assert float(image.depth[16, 16]) == pytest.approx(1.8, abs=1e-5)
    red, green, _ = np.asarray(image.rgb[16, 16])
    assert red > 0.7 > 0.5 > green  # the material's colour with a white highlight
    shell = _render(render.compile_scene(model, geom_groups=(0, 3)), frames, eye, size=(33, 33))
    assert int(shell.geom_id[16, 16]) == 3


def test_camera_from_view_pose_looks_at_the_centre() -> None:
    pose = view_pose(View(jnp.float32(0.7), jnp.float32(1.0)), jnp.zeros(3), 2.0)
    camera = render.camera_from_pose(pose, 0.5)
    model, data = _small()
    image = _render(render.compile_scene(model), poses(model, data), camera, size=(33, 33))
    assert int(image.geom_id[16, 16]) == 1
    assert float(image.depth[16, 16]) == pytest.approx(1.8, abs=1e-5)


def test_vmap_equals_single_images_and_colours_do_not_retrace() -> None:
    model, data = _small()
    frames, scene = poses(model, data), render.compile_scene(model)
    eye = render.camera(frames, model, "eye")
    positions = eye.position[None] + jnp.array([[0.0, 0.0, 0.0], [0.1, 0.0, 0.2], [0.0, 3.0, 0.0]])
    traces = []

    def render_one(rgb: jax.Array, position: jax.Array) -> render.Image:
        traces.append(1)
        return render.render(scene.replace(rgb=rgb), frames, eye.replace(position=position), size=(24, 24))

    batch = jax.jit(jax.vmap(render_one))
    colours = jnp.stack([scene.rgb, scene.rgb[:, ::-1], scene.rgb])
    images = batch(colours, positions)
    darker = batch(colours * 0.5, positions)
    assert len(traces) == 1
    assert float(jnp.abs(images.rgb - darker.rgb).max()) > 0.1
    for i in range(3):
        single = _render(scene.replace(rgb=colours[i]), frames, eye.replace(position=positions[i]), size=(24, 24))
        np.testing.assert_array_equal(images.geom_id[i], single.geom_id)
        np.testing.assert_allclose(images.rgb[i], single.rgb, atol=1e-5)


def test_errors_of_unsupported_models_name_the_cause() -> None:
    texture = mujoco.MjModel.from_xml_string("""
      <mujoco><asset><texture name="c" type="2d" builtin="checker" width="8" height="8"/>
      <material name="tiles" texture="c"/></asset>
      <worldbody><geom name="floor" type="plane" size="1 1 1" material="tiles"/></worldbody></mujoco>""")
    texture.tex_nchannel[0] = 1
    with pytest.raises(render.RenderError, match=r"'floor'.*'c' with 1 channels"):
        render.compile_scene(texture)
    model, data = _small()
    with pytest.raises(render.RenderError, match="geom_groups"):
        render.compile_scene(model, geom_groups=(5,))
    with pytest.raises(render.RenderError, match=r"'nose'.*eye"):
        render.camera(poses(model, data), model, "nose")


FLEX = """
<mujoco><worldbody><geom size=".1"/>
  <flexcomp name="cloth" type="grid" count="3 3 1" spacing=".1 .1 .1" dim="2" radius=".01"{attributes}/>
</worldbody></mujoco>
"""


@pytest.mark.parametrize(("attributes", "is_drawn"), [("", True), (' rgba="1 1 1 0"', False), (' group="4"', False)])
def test_visible_flex_raises(attributes: str, is_drawn: bool) -> None:
    model = mujoco.MjModel.from_xml_string(FLEX.format(attributes=attributes))
    if is_drawn:
        with pytest.raises(render.RenderError, match=r"flex 'cloth' \(number 0\) cannot be rendered"):
            render.compile_scene(model)
    else:
        assert render.compile_scene(model).geom_ids == (0,)


def test_transparent_geom_is_logged(caplog: pytest.LogCaptureFixture) -> None:
    glass = '<geom name="glass" size=".5" rgba="1 0 0 .4"/>'
    render.compile_scene(_small(glass)[0])
    assert "drawn opaque" in caplog.text and "glass" in caplog.text


@pytest.mark.parametrize("size", [(0, 8), (8, 40_000)])
def test_error_of_image_size_names_the_range(size: tuple[int, int]) -> None:
    model, data = _small()
    frames = poses(model, data)
    eye = render.camera(frames, model, "eye")
    with pytest.raises(render.RenderError, match=r"size is \(.*; allowed: height and width from 1 to 32767"):
        render.render(render.compile_scene(model), frames, eye, size)
