"""Shadows of primitives against `mj_ray`, MuJoCo's light model against its formula, and lights on bodies."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mujoco import mjtLightType, mjx

from oracles.render import (
    cast_image,
    cast_points,
    forward,
    on_outline,
    pixel_directions,
    poses,
    random_scene,
    reached_by_light,
)
from vsearch_jax import render

SIZE = (48, 64)
LIT_PLANE = """
<mujoco>
  <visual><headlight ambient=".1 .11 .12" diffuse=".2 .21 .22" specular=".3 .31 .32"/></visual>
  <asset><material name="m" rgba=".5 .4 .3 1" specular=".6" shininess=".1" emission=".05"/></asset>
  <worldbody>
    <light type="directional" dir="-.3 .2 -1" ambient=".02 .03 .04" diffuse=".3 .2 .1" specular=".1 .2 .3"
           castshadow="false"/>
    <light type="spot" pos="1 .5 1.5" dir="-1 -.5 -1.5" cutoff="30" exponent="7" attenuation=".5 .2 .1"
           ambient=".01 .02 .03" diffuse=".5 .4 .3" specular=".4 .4 .4"/>
    <light type="directional" dir="0 0 1" diffuse="9 9 9" active="false"/>
    <light type="directional" dir="-1 0 .05" ambient=".02 0 0" diffuse="1 1 1" specular="1 1 1"
           castshadow="false"/>
    <geom type="plane" size="0 0 1" material="m"/>
    <camera name="eye" pos=".2 -1 1" xyaxes="1 0 0 0 .7 .7" fovy="50"/>
  </worldbody>
</mujoco>
"""

_render = jax.jit(render.render, static_argnames="size")


@pytest.mark.parametrize("light", [mjtLightType.mjLIGHT_DIRECTIONAL, mjtLightType.mjLIGHT_POINT], ids=lambda x: x.name)
@given(seed=st.integers(0, 2**31))
@settings(max_examples=8)
def test_shadows_equal_mj_ray_towards_the_light(light: mjtLightType, seed: int) -> None:
    model = random_scene(np.random.default_rng(seed), light=light)
    data = forward(model)
    frames, scene = poses(model, data), render.compile_scene(model)
    eye = render.camera(frames, model, "eye")
    is_white = np.asarray(_render(scene, frames, eye, size=SIZE).rgb)[..., 0] > 0.5
    points, ids = cast_points(model, data, 0, SIZE)
    is_reached = reached_by_light(model, data, points, ids)
    is_clear = (ids >= 0) & ~on_outline(ids) & ~on_outline(is_reached)
    assert not np.any((is_white != is_reached) & is_clear)
    without_shadows = _render(scene.replace(has_shadows=False), frames, eye, size=SIZE)
    assert np.asarray(without_shadows.rgb)[ids >= 0].min() == 1.0


def test_shade_takes_away_the_lights_that_cast_shadows() -> None:
    model = mujoco.MjModel.from_xml_string(LIT_PLANE)
    without_spot = mujoco.MjModel.from_xml_string(LIT_PLANE.replace('type="spot"', 'type="spot" active="false"'))
    frames = poses(model, forward(model))
    eye = render.camera(frames, model, "eye")
    shade = np.zeros(SIZE, bool)
    shade[10:40, 20:50] = True
    shaded = _render(render.compile_scene(model), frames, eye, size=SIZE, shade=shade)
    lit, dark = (_render(render.compile_scene(one), frames, eye, size=SIZE) for one in (model, without_spot))
    assert np.abs(lit.rgb - dark.rgb)[shade].max() > 0.05
    np.testing.assert_allclose(shaded.rgb, np.where(shade[..., None], dark.rgb, lit.rgb), atol=1e-6)
    np.testing.assert_array_equal(shaded.depth, lit.depth)


def test_light_model_equals_the_formula_of_opengl() -> None:
    model = mujoco.MjModel.from_xml_string(LIT_PLANE)
    data = forward(model)
    frames = poses(model, data)
    image = _render(render.compile_scene(model), frames, render.camera(frames, model, "eye"), size=SIZE)
    directions = pixel_directions(model, data, 0, SIZE)
    depth, _ = cast_image(model, data, 0, SIZE)
    points = data.cam_xpos[0] + depth[..., None] * directions
    to_camera = -directions / np.linalg.norm(directions, axis=-1, keepdims=True)
    colour, normal = np.array([0.5, 0.4, 0.3]), np.array([0.0, 0.0, 1.0])

    def light_term(to_light: np.ndarray, strength: np.ndarray, light: tuple[np.ndarray, ...]) -> np.ndarray:
        to_light = np.broadcast_to(to_light, points.shape)
        cosine = (to_light @ normal)[..., None]
        half = to_light + to_camera
        highlight = ((half / np.linalg.norm(half, axis=-1, keepdims=True)) @ normal)[..., None] ** (128 * 0.1)
        ambient, diffuse, specular = light
        matte = colour * (ambient + diffuse * np.maximum(cosine, 0.0))
        return strength[..., None] * (matte + (cosine > 0.0) * 0.6 * specular * highlight)

    def light_colours(i: int) -> tuple[np.ndarray, ...]:
        return model.light_ambient[i], model.light_diffuse[i], model.light_specular[i]

    to_spot = data.light_xpos[1] - points
    distance = np.linalg.norm(to_spot, axis=-1)
    to_spot = to_spot / distance[..., None]
    axis_cosine = -to_spot @ data.light_xdir[1]
    cone = np.where(axis_cosine >= np.cos(np.deg2rad(30.0)), axis_cosine**7, 0.0)
    headlight = (np.array([0.1, 0.11, 0.12]), np.array([0.2, 0.21, 0.22]), np.array([0.3, 0.31, 0.32]))
    backward, ones = data.cam_xmat[0].reshape(3, 3)[:, 2], np.ones(SIZE)
    expected = 0.05 * colour * np.ones((*SIZE, 1))  # emission
    expected = expected + light_term(-data.light_xdir[0], ones, light_colours(0))
    expected = expected + light_term(to_spot, cone / (0.5 + 0.2 * distance + 0.1 * distance**2), light_colours(1))
    expected = expected + light_term(-data.light_xdir[3], ones, light_colours(3))  # from below the plane
    expected = expected + light_term(backward, ones, headlight)
    assert 0.0 < (cone > 0.0).mean() < 1.0
    np.testing.assert_allclose(image.rgb, np.clip(expected, 0.0, 1.0), atol=1e-4)


def _plane_under_lamp(lamp: str) -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(
        '<mujoco><visual><headlight ambient="0 0 0" diffuse="0 0 0" specular="0 0 0"/></visual>'
        f'<worldbody>{lamp}<geom type="plane" size="0 0 1"/><camera name="eye" pos="0 0 2" fovy="50"/></worldbody>'
        "</mujoco>"
    )


def test_light_on_a_body_moves_with_the_body() -> None:
    fixed = _plane_under_lamp('<light type="spot" pos=".3 0 1" dir="-.3 0 -1" diffuse="1 1 1"/>')
    moving = _plane_under_lamp(
        '<body name="lamp" pos=".3 0 0"><joint type="slide" axis="0 0 1"/><geom size=".01" mass="1" group="3"/>'
        '<light type="spot" pos="0 0 .2" dir="-.3 0 -1" diffuse="1 1 1"/></body>'
    )
    data = forward(moving)
    data.qpos[0] = 0.8
    mujoco.mj_forward(moving, data)
    mjx_model = mjx.put_model(moving)
    mjx_data = mjx.kinematics(mjx_model, mjx.make_data(mjx_model).replace(qpos=jnp.array([0.8])))
    eye = render.camera(poses(moving, data), moving, "eye")
    of_mjx = _render(render.compile_scene(moving), mjx_data, eye, size=SIZE)
    of_mujoco = _render(render.compile_scene(moving), render.poses(data), eye, size=SIZE)
    np.testing.assert_allclose(of_mjx.rgb, of_mujoco.rgb, atol=1e-5)
    frames = poses(fixed, forward(fixed))
    expected = _render(render.compile_scene(fixed), frames, render.camera(frames, fixed, "eye"), size=SIZE)
    assert float(expected.rgb.max()) > 0.2
    np.testing.assert_allclose(of_mjx.rgb, expected.rgb, atol=1e-4)
