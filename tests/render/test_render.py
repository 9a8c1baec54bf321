from __future__ import annotations

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mujoco import mjtGeom, mjtLightType

from oracles.render import (
    MOST_GEOMS,
    cast_image,
    forward,
    on_outline,
    pixel_directions,
    poses,
    random_scene,
    random_size,
    reached_by_light,
)
from vsearch_jax import render
from vsearch_jax.geometry import view_pose
from vsearch_jax.render.geometry.rays import CHORD_FUNCTIONS, RAY_FUNCTIONS
from vsearch_jax.types import View

# f32 against C MuJoCo's f64: at a distance of about 1 m, the root of a discriminant of size r^2 that was rounded at
# 1e-7 is off by 1e-7 / r, for radii of 0.05 m some 1e-5 where the ray does not graze.
RAY_TOLERANCE = 1e-4
# What a Newton step leaves is f32's own rounding of a point some metres from the origin.
DEPTH_TOLERANCE = 2e-6
# Rays that hit a solid of one size and miss it when it is this much larger or smaller graze it: either answer is right.
GRAZE = 1e-3

SIZE = (48, 64)
SEEDS = st.integers(0, 2**31)


def _triple(vectors: np.ndarray) -> tuple[jax.Array, jax.Array, jax.Array]:
    x, y, z = (jnp.asarray(v, dtype=jnp.float32) for v in np.moveaxis(vectors, -1, 0))
    return x, y, z


def _ray_geom(kind: int, size: np.ndarray, points: np.ndarray, directions: np.ndarray) -> np.ndarray:
    identity = np.eye(3).reshape(9)
    distances = [
        mujoco.mju_rayGeom(np.zeros(3), identity, size, p, d, kind) for p, d in zip(points, directions, strict=True)
    ]
    return np.where(np.array(distances) < 0.0, np.inf, distances)


def _random_rays(rng: np.random.Generator, count: int) -> tuple[np.ndarray, np.ndarray]:
    # Half of the origins lie within reach of the solid, half outside; directions need not have length 1.
    points = rng.normal(size=(count, 3)) * np.where(np.arange(count) % 2, 0.2, 1.5)[:, None]
    aims = rng.normal(size=(count, 3)) * 0.3
    directions = (aims - points) * rng.uniform(0.3, 3.0, size=(count, 1))
    directions[: count // 8, rng.integers(3)] = 0.0  # along a face
    return points, directions


@pytest.mark.parametrize("kind", sorted(RAY_FUNCTIONS), ids=lambda kind: mjtGeom(kind).name)
@given(seed=SEEDS)
@settings(max_examples=12)
def test_primitive_equals_mj_ray(kind: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    size = random_size(kind, rng)
    points, directions = _random_rays(rng, 256)
    expected = _ray_geom(kind, size, points, directions)
    distances = np.asarray(_jitted(RAY_FUNCTIONS[kind])(_triple(size), _triple(points), _triple(directions)))
    grown = _ray_geom(kind, size * (1.0 + GRAZE), points, directions)
    shrunk = _ray_geom(kind, size * (1.0 - GRAZE), points, directions)
    is_met = np.isfinite(grown) & np.isfinite(shrunk)
    moved = np.abs(np.where(is_met, grown, 0.0) - np.where(is_met, shrunk, 0.0))
    is_clear = (np.isinf(grown) == np.isinf(shrunk)) & (moved < 30.0 * GRAZE)
    assert is_clear.mean() > 0.6
    assert not np.isnan(distances).any()
    np.testing.assert_allclose(distances[is_clear], expected[is_clear], rtol=RAY_TOLERANCE, atol=RAY_TOLERANCE)


@pytest.mark.parametrize("kind", sorted(CHORD_FUNCTIONS), ids=lambda kind: mjtGeom(kind).name)
@given(seed=SEEDS)
@settings(max_examples=12)
def test_chord_is_met_where_the_line_meets_the_solid(kind: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    size = random_size(kind, rng)
    points, directions = _random_rays(rng, 256)
    chord = np.asarray(_jitted(CHORD_FUNCTIONS[kind])(_triple(size), _triple(points), _triple(directions)))
    far = points - 20.0 * directions

    def is_met(scale: float) -> np.ndarray:
        met = np.isfinite(_ray_geom(kind, size * scale, far, directions))
        # A plane is met from its front only; turned over, it is met from the other side.
        turned = np.array([1.0, -1.0, -1.0])
        return met | np.isfinite(_ray_geom(kind, size * scale, far * turned, directions * turned))

    is_clear = is_met(1.0 + GRAZE) == is_met(1.0 - GRAZE)
    assert np.array_equal(np.isfinite(chord)[is_clear], is_met(1.0)[is_clear])
    chosen = np.isfinite(chord) & is_clear
    inside = points[chosen] + chord[chosen, None] * directions[chosen]
    if kind != mjtGeom.mjGEOM_PLANE and len(inside):
        outward = inside / np.maximum(np.linalg.norm(inside, axis=1, keepdims=True), 1e-9) + 1e-3
        # From inside, a ray out meets the wall, and the ray back meets the wall too.
        assert np.isfinite(_ray_geom(kind, size * (1.0 + GRAZE), inside, outward)).all()
        assert np.isfinite(_ray_geom(kind, size * (1.0 + GRAZE), inside, -outward)).all()


_JITTED: dict = {}


def _jitted(function):
    return _JITTED.setdefault(function, jax.jit(function))


_render = jax.jit(render.render, static_argnames="size")


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
    assert model.ngeom <= MOST_GEOMS
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
    # A ray that grazes has a depth that no f32 can tell; such pixels lie next to outlines.
    off = np.abs(np.asarray(image.depth)[is_hit] / depth[is_hit] - 1.0)
    assert np.median(off) < DEPTH_TOLERANCE
    assert (off[~on_outline(ids)[is_hit]] < 1e-4).all()
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
    assert np.asarray(image.rgb).min() > 0.1  # lit as from outside, by the headlight


@pytest.mark.parametrize("light", [mjtLightType.mjLIGHT_DIRECTIONAL, mjtLightType.mjLIGHT_POINT], ids=lambda x: x.name)
@given(seed=SEEDS)
@settings(max_examples=8)
def test_shadows_equal_rays_of_mj_ray_to_the_light(light: mjtLightType, seed: int) -> None:
    model = random_scene(np.random.default_rng(seed), light=light)
    data = forward(model)
    frames, scene = poses(model, data), render.compile_scene(model)
    eye = render.camera(frames, model, "eye")
    is_white = np.asarray(_render(scene, frames, eye, size=SIZE).rgb)[..., 0] > 0.5
    depth, ids = cast_image(model, data, 0, SIZE)
    distances = np.where(np.isfinite(depth), depth, 1.0)[..., None]
    points = data.cam_xpos[0] + distances * pixel_directions(model, data, 0, SIZE)
    is_reached = reached_by_light(model, data, points, ids)
    is_clear = (ids >= 0) & ~on_outline(ids) & ~on_outline(is_reached)
    assert not np.any((is_white != is_reached) & is_clear)
    unshaded = _render(scene.replace(has_shadows=False), frames, eye, size=SIZE)
    assert np.asarray(unshaded.rgb)[ids >= 0].min() == 1.0


def test_light_model_equals_opengls_formula() -> None:
    model = mujoco.MjModel.from_xml_string("""
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
      </mujoco>""")
    data = forward(model)
    frames = poses(model, data)
    image = _render(render.compile_scene(model), frames, render.camera(frames, model, "eye"), size=SIZE)
    directions = pixel_directions(model, data, 0, SIZE)
    depth, _ = cast_image(model, data, 0, SIZE)
    points = data.cam_xpos[0] + depth[..., None] * directions
    view = -directions / np.linalg.norm(directions, axis=-1, keepdims=True)
    colour, normal = np.array([0.5, 0.4, 0.3]), np.array([0.0, 0.0, 1.0])
    expected = 0.05 * colour * np.ones((*SIZE, 1))

    def add(way: np.ndarray, strength: np.ndarray, light: tuple[np.ndarray, np.ndarray, np.ndarray]) -> np.ndarray:
        cosine = (way @ normal)[..., None]
        half = way + view
        highlight = ((half / np.linalg.norm(half, axis=-1, keepdims=True)) @ normal)[..., None] ** (128 * 0.1)
        ambient, diffuse, specular = light
        matte = colour * (ambient + diffuse * np.maximum(cosine, 0.0))
        return strength[..., None] * (matte + (cosine > 0.0) * 0.6 * specular * highlight)

    def colours(i: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        return model.light_ambient[i], model.light_diffuse[i], model.light_specular[i]

    ones = np.ones(SIZE)
    expected = expected + add(np.broadcast_to(-data.light_xdir[0], points.shape), ones, colours(0))
    way = data.light_xpos[1] - points
    distance = np.linalg.norm(way, axis=-1)
    way = way / distance[..., None]
    axis = -way @ data.light_xdir[1]
    cone = np.where(axis >= np.cos(np.deg2rad(30.0)), axis**7, 0.0)
    expected = expected + add(way, cone / (0.5 + 0.2 * distance + 0.1 * distance**2), colours(1))
    expected = expected + add(np.broadcast_to(-data.light_xdir[3], points.shape), ones, colours(3))  # from behind
    headlight = (np.array([0.1, 0.11, 0.12]), np.array([0.2, 0.21, 0.22]), np.array([0.3, 0.31, 0.32]))
    backward = data.cam_xmat[0].reshape(3, 3)[:, 2]
    expected = expected + add(np.broadcast_to(backward, points.shape), ones, headlight)
    assert 0.0 < (cone > 0.0).mean() < 1.0
    np.testing.assert_allclose(image.rgb, np.clip(expected, 0.0, 1.0), atol=1e-4)


SMALL = """
<mujoco>
  <asset><material name="red" rgba="1 0 0 1"/></asset>
  <worldbody>
    <light name="sun" type="directional" dir="0 0 -1"/>
    <geom name="floor" type="plane" size="1 1 1" pos="0 0 -.5"/>
    <geom name="ball" type="sphere" size=".2" material="red"/>
    <geom name="ghost" type="sphere" size=".4" rgba="1 1 1 0"/>
    <geom name="shell" type="sphere" size=".3" group="3"/>
    <camera name="eye" pos="0 0 2" fovy="70"/>
    {extra}
  </worldbody>
</mujoco>
"""


def _small(extra: str = "") -> tuple[mujoco.MjModel, mujoco.MjData]:
    model = mujoco.MjModel.from_xml_string(SMALL.format(extra=extra))
    return model, forward(model)


def test_alpha_groups_misses_and_silhouette() -> None:
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
    assert red > 0.7 > 0.5 > green  # the material's colour, with a white highlight
    shell = _render(render.compile_scene(model, geom_groups=(0, 3)), frames, eye, size=(33, 33))
    assert int(shell.geom_id[16, 16]) == 3


def test_pose_gives_the_camera_of_the_view() -> None:
    pose = view_pose(View(jnp.float32(0.7), jnp.float32(1.0)), jnp.zeros(3), 2.0)
    camera = render.camera_from_pose(pose, 0.5)
    model, data = _small()
    image = _render(render.compile_scene(model), poses(model, data), camera, size=(33, 33))
    assert int(image.geom_id[16, 16]) == 1
    assert float(image.depth[16, 16]) == pytest.approx(1.8, abs=1e-5)


def test_vmap_equals_one_by_one_and_colours_are_arguments() -> None:
    model, data = _small()
    frames, scene = poses(model, data), render.compile_scene(model)
    eye = render.camera(frames, model, "eye")
    positions = eye.position[None] + jnp.array([[0.0, 0.0, 0.0], [0.1, 0.0, 0.2], [0.0, 3.0, 0.0]])
    traces = []

    def one(rgb: jax.Array, position: jax.Array):
        traces.append(1)
        return render.render(scene.replace(rgb=rgb), frames, eye.replace(position=position), size=(24, 24))

    batch = jax.jit(jax.vmap(one))
    colours = jnp.stack([scene.rgb, scene.rgb[:, ::-1], scene.rgb])
    images = batch(colours, positions)
    again = batch(colours * 0.5, positions)
    assert len(traces) == 1
    assert float(jnp.abs(images.rgb - again.rgb).max()) > 0.1
    for i in range(3):
        alone = _render(scene.replace(rgb=colours[i]), frames, eye.replace(position=positions[i]), size=(24, 24))
        np.testing.assert_array_equal(images.geom_id[i], alone.geom_id)
        np.testing.assert_allclose(images.rgb[i], alone.rgb, atol=1e-5)


def test_gradients_are_finite_and_follow_the_surface() -> None:
    model = random_scene(np.random.default_rng(3), num_geoms=10)
    frames, scene = poses(model, forward(model)), render.compile_scene(model)
    eye = render.camera(frames, model, "eye")

    def picture(position: jax.Array, frames=frames) -> tuple[jax.Array, jax.Array, jax.Array]:
        image = render.render(scene, frames, eye.replace(position=position), size=(24, 24))
        return jnp.where(image.geom_id >= 0, image.depth, 0.0), image.rgb, image.geom_id

    def total(position: jax.Array, size: jax.Array, xpos: jax.Array, xmat: jax.Array) -> jax.Array:
        moved = frames._replace(geom_xpos=xpos, geom_xmat=xmat)
        image = render.render(scene.replace(size=size), moved, eye.replace(position=position), size=(24, 24))
        return jnp.sum(jnp.where(image.geom_id >= 0, image.depth, 0.0)) + jnp.sum(image.rgb)

    arguments = (eye.position, scene.size, jnp.asarray(frames.geom_xpos), jnp.asarray(frames.geom_xmat))
    gradients = jax.jit(jax.grad(total, argnums=(0, 1, 2, 3)))(*arguments)
    assert all(bool(jnp.all(jnp.isfinite(g))) and float(jnp.abs(g).max()) > 0.0 for g in gradients)

    step, way = 1e-3, jnp.array([0.3, -0.5, 0.8])
    pictures = jax.jit(jax.vmap(picture))(eye.position[None] + step * jnp.array([[-1.0], [1.0]]) * way[None])
    (depth, rgb, ids), (depth_rate, rgb_rate, _) = jax.jit(lambda p: jax.jvp(picture, (p,), (way,)))(eye.position)
    interior = ~on_outline(np.asarray(ids)) & np.all(np.asarray(pictures[2]) == np.asarray(ids), axis=0)
    for value, rate in ((pictures[0], depth_rate), (pictures[1], rgb_rate)):
        difference = np.asarray((value[1] - value[0]) / (2 * step))
        error = np.abs(np.asarray(rate) - difference)[interior]
        # Edges of boxes and of shadows are not smooth; a difference quotient in f32 is good to about 1e-3.
        assert np.mean(error < 5e-3 + 0.01 * np.abs(difference[interior])) > 0.9
    assert depth.shape == (24, 24) and rgb.shape == (24, 24, 3)


def test_unsupported_models_raise_by_name() -> None:
    tracking, _ = _small('<body><joint/><geom size=".1"/><light name="torch" mode="trackcom"/></body>')
    with pytest.raises(render.RenderError, match=r"'torch'.*mjCAMLIGHT_TRACKCOM"):
        render.compile_scene(tracking)
    texture = mujoco.MjModel.from_xml_string("""
      <mujoco><asset><texture name="c" type="2d" builtin="checker" width="8" height="8"/>
      <material name="tiles" texture="c"/></asset>
      <worldbody><geom name="floor" type="plane" size="1 1 1" material="tiles"/></worldbody></mujoco>""")
    texture.tex_nchannel[0] = 1
    with pytest.raises(render.RenderError, match=r"'floor'.*'c' of 1 channels"):
        render.compile_scene(texture)
    model, data = _small()
    with pytest.raises(render.RenderError, match="geom_groups"):
        render.compile_scene(model, geom_groups=(5,))
    with pytest.raises(render.RenderError, match=r"'nose'.*eye"):
        render.camera(poses(model, data), model, "nose")
