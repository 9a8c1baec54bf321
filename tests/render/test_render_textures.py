"""Textures of planes and solids, and the skybox."""

from __future__ import annotations

import jax
import mujoco
import numpy as np
import pytest

from oracles.render import cast_points, forward, poses
from vsearch_jax import render
from vsearch_jax.render.texture.atlas import compile_textures

SIZE = (48, 64)
TEXTURES = """
  <texture name="check" type="2d" builtin="checker" rgb1="1 0 0" rgb2="0 0 1" width="64" height="64"/>
  <texture name="sky" type="skybox" builtin="flat" rgb1="0 1 0" rgb2="0 1 0" width="16" height="16"/>
  <texture name="cube" type="cube" builtin="flat" rgb1="1 0 0" rgb2="0 0 1" width="16" height="96"/>
"""

_render = jax.jit(render.render, static_argnames="size")


def _model(geom: str, material: str) -> mujoco.MjModel:
    """Returns a model with one geom under purely ambient light, so that a pixel has the colour of the texture."""
    return mujoco.MjModel.from_xml_string(
        '<mujoco><visual><headlight ambient="1 1 1" diffuse="0 0 0" specular="0 0 0"/></visual>'
        f"<asset>{TEXTURES}{material}</asset><worldbody>{geom}"
        '<camera name="eye" pos="0 0 2" fovy="50"/></worldbody></mujoco>'
    )


def _rgb(model: mujoco.MjModel) -> np.ndarray:
    frames = poses(model, forward(model))
    image = _render(render.compile_scene(model), frames, render.camera(frames, model, "eye"), size=SIZE)
    return np.asarray(image.rgb)


@pytest.mark.parametrize("is_uniform", [False, True])
def test_checkered_plane_has_mujocos_texture_coordinates(is_uniform: bool) -> None:
    uniform = str(is_uniform).lower()
    material = f'<material name="tiles" rgba="1 1 1 1" texture="check" texrepeat="2 3" texuniform="{uniform}"/>'
    model = _model('<geom type="plane" size=".7 .5 .1" material="tiles"/>', material)
    rgb = _rgb(model)
    points, ids = cast_points(model, forward(model), 0, SIZE)
    repeat = np.array([2.0, 3.0]) * (np.array([0.7, 0.5]) if is_uniform else 1.0)
    texcoord = np.stack([0.5 + 0.5 * points[..., 0] / 0.7, 0.5 - 0.5 * points[..., 1] / 0.5], axis=-1) * repeat
    is_red = (np.floor(2.0 * texcoord).sum(axis=-1) % 2) == 0
    # A pixel is about 0.08 of a square wide. The filter blurs the two pixels next to an edge.
    is_clear = (ids == 0) & (np.abs(2.0 * texcoord - np.round(2.0 * texcoord)).min(axis=-1) > 0.2)
    assert is_clear.sum() > 100
    for is_colour, colour in ((is_clear & is_red, [1, 0, 0]), (is_clear & ~is_red, [0, 0, 1])):
        np.testing.assert_allclose(rgb[is_colour], [colour] * is_colour.sum(), atol=0.02)
    is_sky = ids < 0
    np.testing.assert_allclose(rgb[is_sky], [[0, 1, 0]] * is_sky.sum(), atol=0.01)


@pytest.mark.parametrize("kind", ["sphere", "box", "ellipsoid"])
def test_cube_texture_has_its_second_colour_on_one_side(kind: str) -> None:
    material = '<material name="dice" texture="cube" rgba="1 1 1 1"/>'

    def middle_colour(euler: str) -> np.ndarray:
        geom = f'<geom type="{kind}" size=".3 .3 .3" euler="{euler}" material="dice"/>'
        return _rgb(_model(geom, material))[SIZE[0] // 2, SIZE[1] // 2]

    np.testing.assert_allclose(middle_colour("0 0 0"), [1, 0, 0], atol=0.02)
    # MuJoCo's flat cube has rgb2 on its third side. OpenGL's reflection coordinates put this side at -y.
    colours = [middle_colour(euler) for euler in ("-90 0 0", "90 0 0")]
    assert min(float(np.abs(c - [0, 0, 1]).max()) for c in colours) < 0.02


def test_bright_light_and_srgb_equal_mujocos_renderer() -> None:
    """The numbers are those of `mujoco.Renderer`. Each light that casts shadows is clamped alone; cubes stay linear."""
    texture = '<texture builtin="flat" rgb1=".5 .5 .5" rgb2=".5 .5 .5" width="8" '
    model = mujoco.MjModel.from_xml_string(f"""
      <mujoco><visual><headlight ambient=".4 .4 .4" diffuse=".5 .5 .5" specular="0 0 0"/></visual>
      <asset>
        {texture} name="linear" type="2d" height="8"/>
        {texture} name="srgb" type="2d" height="8" colorspace="sRGB"/>
        {texture} name="cube" type="cube" height="48" colorspace="sRGB"/>
        <material name="linear" texture="linear" rgba="1 1 1 1" specular="0"/>
        <material name="srgb" texture="srgb" rgba="1 1 1 1" specular="0"/>
        <material name="cube" texture="cube" rgba="1 1 1 1" specular="0"/>
      </asset>
      <worldbody>
        <light type="directional" dir="0 0 -1" diffuse=".7 .7 .7" specular="0 0 0"/>
        <geom type="box" size=".1 .1 .1" pos="-.4 0 0" material="linear"/>
        <geom type="box" size=".1 .1 .1" material="srgb"/>
        <geom type="box" size=".1 .1 .1" pos=".4 0 0" material="cube"/>
        <camera name="eye" pos="0 0 2" fovy="50"/>
      </worldbody></mujoco>""")
    rgb = 255.0 * _rgb(model)
    scale = SIZE[0] / (2.0 * 1.9 * np.tan(np.deg2rad(25.0)))  # pixels per m on top of the boxes
    columns = [int(0.5 * SIZE[1] + scale * x) for x in (-0.4, 0.0, 0.4)]
    np.testing.assert_allclose(rgb[SIZE[0] // 2, columns], [[203] * 3, [86] * 3, [203] * 3], atol=0.75)


@pytest.mark.parametrize("size", [(100, 100), (63, 63), (17, 300), (1, 7), (64, 64)])
@pytest.mark.parametrize("kind", ["2d", "cube"])
def test_each_mipmap_level_has_the_mean_of_the_texture(size: tuple[int, int], kind: str) -> None:
    height, width = (size[0], size[1]) if kind == "2d" else (6 * size[1], size[1])
    model = mujoco.MjModel.from_xml_string(f"""<mujoco>
      <asset><texture name="t" type="{kind}" builtin="flat" rgb1="1 0 0" width="{width}" height="{height}"/>
      <material name="m" texture="t"/></asset><worldbody><geom size="1" material="m"/></worldbody></mujoco>""")
    model.tex_data[:] = np.random.default_rng(0).integers(0, 256, model.tex_data.size)
    model.tex_data[: model.tex_data.size // 2] //= 2
    atlas = compile_textures(model, np.array([0]))
    assert atlas is not None
    images = model.tex_data.reshape(-1, (height if kind == "2d" else width) * width, 3)
    starts = np.asarray(atlas.start).reshape(6, atlas.num_levels)
    side_height, side_width = (int(n[0]) for n in (atlas.height, atlas.width))
    for side, level in np.ndindex(starts.shape):
        count = max(side_height >> level, 1) * max(side_width >> level, 1)
        texels = np.asarray(atlas.texels)[starts[side, level] : starts[side, level] + count]
        means = [(texels >> shift & 0xFF).mean() for shift in (0, 8, 16)]
        np.testing.assert_allclose(means, images[side % len(images)].mean(axis=0), atol=0.51)


def test_endless_plane_with_a_uniform_cube_compiles_without_a_warning() -> None:
    model = _model(
        '<geom type="plane" size="0 0 1" material="dice"/>',
        '<material name="dice" texture="cube" texuniform="true"/>',
    )
    with np.errstate(all="raise"):
        assert compile_textures(model, np.array([0])) is not None
