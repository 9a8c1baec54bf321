from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from jaxlie import SE3, SO3
from mujoco import mjx

from oracles.render import cast_image, forward, on_outline, pixel_directions, poses
from vsearch_jax import render

SIZE = (48, 64)
_render = jax.jit(render.render, static_argnames="size")
EXAMPLE = Path(__file__).resolve().parent.parent / "examples" / "workshop.xml"

BRIGHT = '<visual><headlight ambient="1 1 1" diffuse="0 0 0" specular="0 0 0"/></visual>'
CHECKER = """
  <texture name="check" type="2d" builtin="checker" rgb1="1 0 0" rgb2="0 0 1" width="64" height="64"/>
  <texture name="sky" type="skybox" builtin="flat" rgb1="0 1 0" rgb2="0 1 0" width="16" height="16"/>
  <texture name="cube" type="cube" builtin="flat" rgb1="1 0 0" rgb2="0 0 1" width="16" height="96"/>
"""


def _model(body: str, assets: str = CHECKER) -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(
        f"<mujoco>{BRIGHT}<asset>{assets}</asset><worldbody>{body}"
        '<camera name="eye" pos="0 0 2" fovy="50"/></worldbody></mujoco>'
    )


def _draw(model: mujoco.MjModel, size: tuple[int, int] = SIZE):
    data = forward(model)
    frames = poses(model, data)
    return _render(render.compile_scene(model), frames, render.camera(frames, model, "eye"), size=size), data


@pytest.mark.parametrize("is_uniform", [False, True])
def test_a_checkered_plane_alternates_where_mujoco_says(is_uniform: bool) -> None:
    uniform = str(is_uniform).lower()
    material = f'<material name="tiles" rgba="1 1 1 1" texture="check" texrepeat="2 3" texuniform="{uniform}"/>'
    model = _model('<geom type="plane" size=".7 .5 .1" material="tiles"/>', CHECKER + material)
    image, data = _draw(model)
    depth, ids = cast_image(model, data, 0, SIZE)
    points = data.cam_xpos[0] + np.where(ids >= 0, depth, 0.0)[..., None] * pixel_directions(model, data, 0, SIZE)
    repeat = np.array([2.0, 3.0]) * (np.array([0.7, 0.5]) if is_uniform else 1.0)
    place = np.stack([0.5 + 0.5 * points[..., 0] / 0.7, 0.5 - 0.5 * points[..., 1] / 0.5], axis=-1) * repeat
    half = np.floor(2.0 * place)
    is_red = (half.sum(axis=-1) % 2) == 0
    # A pixel is some 0.08 of a square wide; the filter blurs the two next to an edge.
    is_clear = (ids == 0) & (np.abs(2.0 * place - np.round(2.0 * place)).min(axis=-1) > 0.2)
    assert is_clear.sum() > 100
    np.testing.assert_allclose(
        np.asarray(image.rgb)[is_clear & is_red], [[1, 0, 0]] * (is_clear & is_red).sum(), atol=0.02
    )
    np.testing.assert_allclose(
        np.asarray(image.rgb)[is_clear & ~is_red], [[0, 0, 1]] * (is_clear & ~is_red).sum(), atol=0.02
    )
    np.testing.assert_allclose(np.asarray(image.rgb)[ids < 0], [[0, 1, 0]] * (ids < 0).sum(), atol=0.01)  # the sky


@pytest.mark.parametrize("kind", ["sphere", "box", "ellipsoid"])
def test_a_cube_texture_has_its_own_colour_on_the_side_below(kind: str) -> None:
    material = '<material name="dice" texture="cube" rgba="1 1 1 1"/>'
    up = _model(f'<geom type="{kind}" size=".3 .3 .3" material="dice"/>', CHECKER + material)
    image, _ = _draw(up)
    np.testing.assert_allclose(image.rgb[24, 32], [1, 0, 0], atol=0.02)
    # MuJoCo's flat cube has rgb2 on its third side, which GL's reflection coordinates put at -y.
    side = _model(f'<geom type="{kind}" size=".3 .3 .3" euler="-90 0 0" material="dice"/>', CHECKER + material)
    other = _model(f'<geom type="{kind}" size=".3 .3 .3" euler="90 0 0" material="dice"/>', CHECKER + material)
    colours = [np.asarray(_draw(model)[0].rgb[24, 32]) for model in (side, other)]
    assert min(float(np.abs(c - [0, 0, 1]).max()) for c in colours) < 0.02


def test_a_light_on_a_body_shines_from_where_the_body_is() -> None:
    fixed = _model(
        '<light type="spot" pos=".3 0 1" dir="-.3 0 -1" diffuse="1 1 1"/><geom type="plane" size="0 0 1"/>', ""
    )
    moving = _model(
        '<body name="lamp" pos=".3 0 0"><joint type="slide" axis="0 0 1"/><geom size=".01" mass="1" group="3"/>'
        '<light type="spot" pos="0 0 .2" dir="-.3 0 -1" diffuse="1 1 1"/></body><geom type="plane" size="0 0 1"/>',
        "",
    )
    for model in (fixed, moving):
        model.vis.headlight.ambient[:] = 0.0
    data = forward(moving)
    data.qpos[0] = 0.8
    mujoco.mj_forward(moving, data)
    mjx_model = mjx.put_model(moving)
    frames = mjx.kinematics(mjx_model, mjx.make_data(mjx_model).replace(qpos=jnp.array([0.8])))
    eye = render.camera(poses(moving, data), moving, "eye")
    image = _render(render.compile_scene(moving), frames, eye, size=SIZE)
    same = _render(render.compile_scene(moving), render.poses(data), eye, size=SIZE)
    np.testing.assert_allclose(image.rgb, same.rgb, atol=1e-5)
    expected, _ = _draw(fixed)
    assert float(expected.rgb.max()) > 0.2
    np.testing.assert_allclose(image.rgb, expected.rgb, atol=1e-4)


def test_a_matrix_and_a_field_of_view_give_one_camera() -> None:
    model = _model('<geom type="box" size=".3 .2 .1"/>')
    frames, scene = poses(model, forward(model)), render.compile_scene(model)
    by_angle = render.camera(frames, model, "eye")
    focal = 0.5 * SIZE[0] / np.tan(0.5 * np.deg2rad(50))
    matrix = jnp.array([[focal, 0, (SIZE[1] - 1) / 2], [0, focal, (SIZE[0] - 1) / 2], [0, 0, 1]])
    pose = SE3.from_rotation_and_translation(SO3.identity(), jnp.array([0.0, 0.0, 2.0]))
    by_matrix = render.camera_from_matrix(pose, matrix)
    expected = _render(scene, frames, by_angle, size=SIZE)
    image = _render(scene, frames, by_matrix, size=SIZE)
    np.testing.assert_array_equal(image.geom_id, expected.geom_id)
    np.testing.assert_allclose(image.rgb, expected.rgb, atol=1e-5)
    shifted = render.camera_from_matrix(pose, matrix.at[0, 2].add(7.0).at[1, 2].add(-5.0))
    moved = _render(scene, frames, shifted, size=SIZE)
    np.testing.assert_array_equal(moved.geom_id, np.roll(expected.geom_id, (-5, 7), axis=(0, 1)))
    fine = jax.jit(render.supersample, static_argnames=("size", "factor"))
    for camera in (by_angle, by_matrix):
        smooth = fine(scene, frames, camera, size=SIZE, factor=3)
        np.testing.assert_array_equal(smooth.geom_id, expected.geom_id)
        inside = ~on_outline(np.asarray(expected.geom_id))
        np.testing.assert_allclose(smooth.rgb[inside], expected.rgb[inside], atol=0.02)
        edge = np.asarray(smooth.rgb).sum(axis=-1)
        assert ((edge > 0.02) & (edge < 0.9 * edge.max())).sum() > 20  # steps are smoothed
    with pytest.raises(render.RenderError, match="factor is 2"):
        render.supersample(scene, frames, by_angle, SIZE, 2)


def test_a_soft_silhouette_follows_what_moves_the_outline() -> None:
    model = _model('<geom name="ball" size=".3"/><geom type="plane" size="0 0 1" pos="0 0 -1"/>')
    frames, scene = poses(model, forward(model)), render.compile_scene(model)
    eye = render.camera(frames, model, "eye")

    def area(height: jax.Array) -> jax.Array:
        camera = eye.replace(position=jnp.stack([jnp.float32(0.05), jnp.float32(0.02), height]))
        return jnp.sum(render.soft_silhouette(scene, frames, camera, (128, 128), (0,)))

    def exact(height: float) -> float:  # of the ball's image, all but round
        scale = 64 / np.tan(np.deg2rad(25))
        return np.pi * (scale * 0.3 / np.sqrt(height**2 - 0.09)) ** 2

    value, slope = jax.jit(jax.value_and_grad(area))(jnp.float32(1.6))
    assert float(value) == pytest.approx(exact(1.6), rel=0.03)
    assert float(slope) == pytest.approx((exact(1.601) - exact(1.599)) / 0.002, rel=0.1)

    def column(x: jax.Array) -> jax.Array:  # of the silhouette's middle
        moved = frames._replace(geom_xpos=jnp.asarray(frames.geom_xpos).at[0, 0].set(x))
        mask = render.soft_silhouette(scene, moved, eye, (128, 128), (0,))
        return jnp.sum(mask * jnp.arange(128.0)[None]) / jnp.sum(mask)

    rate = jax.jit(jax.grad(column))(jnp.float32(0.0))
    assert float(rate) == pytest.approx(64 / np.tan(np.deg2rad(25)) / 2.0, rel=0.1)


def test_a_crop_is_square_around_the_object() -> None:
    picture = np.zeros((40, 60, 3), np.float32)
    picture[10:20, 30:50] = [0.2, 0.6, 1.0]
    square = render.square_around(jnp.asarray(picture[..., 0] > 0), margin=0.0)
    assert (float(square.row), float(square.column), float(square.edge)) == (15.0, 40.0, 20.0)
    part = np.asarray(render.crop(jnp.asarray(picture), square, 40))
    np.testing.assert_allclose(part[12:28, 2:38], np.broadcast_to([0.2, 0.6, 1.0], (16, 36, 3)), atol=1e-5)
    assert not part[:8].any() and not part[32:].any()
    empty = render.square_around(jnp.zeros((40, 60), bool))
    assert (float(empty.row), float(empty.column), float(empty.edge)) == (20.0, 30.0, 40.0)


_OPENGL = """
import sys, mujoco, numpy as np
model = mujoco.MjModel.from_xml_path(sys.argv[1])
data = mujoco.MjData(model)
mujoco.mj_forward(model, data)
with mujoco.Renderer(model, 480, 640) as renderer:
    renderer.update_scene(data, "room")
    for flag in (mujoco.mjtRndFlag.mjRND_HAZE, mujoco.mjtRndFlag.mjRND_REFLECTION):
        renderer.scene.flags[flag] = 0
    np.save(sys.argv[2], renderer.render())
"""


@pytest.mark.slow
def test_colours_are_those_of_mujocos_renderer(tmp_path: Path) -> None:
    path = tmp_path / "picture.npy"
    for library in ("egl", "osmesa"):  # chosen when MuJoCo is imported, hence in a process of its own
        command = [sys.executable, "-c", _OPENGL, str(EXAMPLE), str(path)]
        if not subprocess.run(
            command, env=os.environ | {"MUJOCO_GL": library}, check=False, capture_output=True
        ).returncode:
            break
    else:
        pytest.skip("MuJoCo finds neither EGL nor OSMesa here")
    model = mujoco.MjModel.from_xml_path(str(EXAMPLE))
    data = forward(model)
    frames = render.poses(data)
    scene, eye = render.compile_scene(model), render.camera(frames, model, "room")
    image = _render(scene, frames, eye, size=(480, 640))
    unshaded = _render(scene.replace(has_shadows=False), frames, eye, size=(480, 640))
    _, ids = cast_image(model, data, 0, (480, 640))
    is_shaded = np.abs(np.asarray(image.rgb - unshaded.rgb)).sum(axis=-1) > 0.01
    is_clear = ~on_outline(ids) & ~on_outline(is_shaded)
    off = np.abs(255.0 * np.asarray(image.rgb) - np.load(path))[is_clear]
    assert off.mean() <= 2.0
