"""Meshes and height fields: images, normals, shadows and derivatives."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mujoco import mjtGeom, mjtLightType

from oracles.render import (
    cast_image,
    cast_points,
    forward,
    on_outline,
    pixel_directions,
    poses,
    random_closed_mesh,
    random_scene,
    reached_by_light,
)
from vsearch_jax import render
from vsearch_jax.render.geometry.triangles import compile_triangles

SIZE = (48, 64)
# The last seed has the largest error found: under a point light, a narrow shadow where a mesh intersects a capsule.
SHADOW_SEEDS = (*range(6), 513)
_render = jax.jit(render.render, static_argnames="size")


def _mesh_model(num_faces: int | None = None, light: str = "") -> mujoco.MjModel:
    vertices, faces = random_closed_mesh(np.random.default_rng(5), 14)
    vertices = 3.0 * vertices
    spec = mujoco.MjSpec.from_string(f"<mujoco><worldbody>{light}</worldbody></mujoco>")
    shell = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
    spec.add_mesh(name="m", uservert=vertices.reshape(-1), userface=faces[:num_faces].reshape(-1), inertia=shell)
    body = spec.worldbody.add_body(pos=[0.1, -0.05, 0.2], quat=[0.9, 0.3, -0.2, 0.1])
    body.add_geom(type=mjtGeom.mjGEOM_MESH, meshname="m", rgba=[1, 1, 1, 1])
    spec.worldbody.add_camera(name="eye", pos=[0, 0, 2.5], fovy=50)
    return spec.compile()


def _draw(model: mujoco.MjModel, data: mujoco.MjData) -> render.Image:
    frames = poses(model, data)
    return _render(render.compile_scene(model), frames, render.camera(frames, model, "eye"), size=SIZE)


def test_closed_and_open_meshes_are_distinguished() -> None:
    def is_closed(model: mujoco.MjModel) -> float:
        triangles = compile_triangles(model, np.flatnonzero(model.geom_type == mjtGeom.mjGEOM_MESH))
        assert triangles is not None
        return float(triangles.is_closed[0])

    assert is_closed(_mesh_model()) == 1.0
    assert is_closed(_mesh_model(num_faces=-1)) == 0.0


def test_camera_inside_a_mesh_sees_its_wall() -> None:
    model = _mesh_model()
    model.cam_pos[0] = [0.1, -0.05, 0.2]
    data = forward(model)
    depth, ids = cast_image(model, data, 0, SIZE)
    image = _draw(model, data)
    assert (ids == 0).mean() > 0.99
    np.testing.assert_array_equal(image.geom_id, ids)
    np.testing.assert_allclose(image.depth, depth, rtol=1e-5)


def test_face_that_reaches_behind_the_camera_is_drawn() -> None:
    model = mujoco.MjModel.from_xml_string("""
      <mujoco><asset><mesh name="floor" inertia="shell" vertex="-9 -9 0  9 -9 0  9 9 0  -9 9 0  0 0 -1"
          face="0 1 2  0 2 3  0 4 1  1 4 2  2 4 3  3 4 0"/></asset>
      <worldbody><geom type="mesh" mesh="floor"/><camera name="eye" pos="0 0 .5" xyaxes="1 0 0 0 .3 1"/></worldbody>
      </mujoco>""")
    model.geom_pos[:] += [0.01, 0.02, 0.0]  # otherwise rays lie in the plane of the diagonal
    data = forward(model)
    depth, ids = cast_image(model, data, 0, SIZE)
    image = _draw(model, data)
    assert 0.3 < (ids == 0).mean() < 0.9
    assert (np.asarray(image.geom_id) == ids).mean() > 0.999
    is_same = (np.asarray(image.geom_id) == ids) & (ids == 0)
    np.testing.assert_allclose(np.asarray(image.depth)[is_same], depth[is_same], rtol=1e-4)


def test_a_batch_of_different_images_equals_single_images() -> None:
    """In a batch, the faces of all images share one queue: from afar a face has one pixel, from near a thousand."""
    model = _mesh_model(light='<light type="directional" dir="-1 .3 -.6"/>')
    data = forward(model)
    frames, scene = poses(model, data), render.compile_scene(model)
    eye = render.camera(frames, model, "eye")
    heights = jnp.array([[1.2, 40.0, 2.5], [6.0, -3.0, 1.6]])  # below the mesh, the camera sees nothing

    def draw(height: jax.Array) -> render.Image:
        return render.render(scene, frames, eye.replace(position=eye.position.at[2].set(height)), SIZE)

    images, draw_one = jax.jit(jax.vmap(jax.vmap(draw)))(heights), jax.jit(draw)
    for index in np.ndindex(heights.shape):
        single = draw_one(heights[index])
        assert (np.asarray(single.geom_id) == 0).any() == (heights[index] > 0.0)
        np.testing.assert_array_equal(images.geom_id[index], single.geom_id)
        np.testing.assert_allclose(images.depth[index], single.depth, rtol=1e-5)
        np.testing.assert_allclose(images.rgb[index], single.rgb, atol=1e-5)


def test_normals_equal_mj_multi_ray() -> None:
    model = random_scene(np.random.default_rng(11))
    data = forward(model)
    _, ids = cast_image(model, data, 0, SIZE)
    count = SIZE[0] * SIZE[1]
    distances, normals = np.zeros(count), np.zeros((count, 3))
    args = (data.cam_xpos[0], pixel_directions(model, data, 0, SIZE).reshape(-1), None, True, -1)
    mujoco.mj_multiRay(
        model, data, *args, np.zeros(count, np.int32), distances, normals.reshape(-1), count, mujoco.mjMAXVAL
    )
    image = _draw(model, data)
    is_clear = ~on_outline(ids) & (ids >= 0)
    error = np.linalg.norm(np.asarray(image.normal) - normals.reshape(*SIZE, 3), axis=-1)[is_clear]
    assert np.quantile(error, 0.98) < 1e-3  # the others are on edges of boxes and cylinders
    assert not np.asarray(image.normal)[ids < 0].any()


def test_vertex_normals_are_smooth_or_sharp() -> None:
    model = _mesh_model()
    data = forward(model)
    normal = np.asarray(_draw(model, data).normal)
    _, ids = cast_image(model, data, 0, SIZE)
    np.testing.assert_allclose(np.linalg.norm(normal[ids == 0], axis=-1), 1.0, atol=1e-5)
    assert len(np.unique(normal[ids == 0].round(3), axis=0)) > 0.5 * (ids == 0).sum()
    box = mujoco.MjModel.from_xml_string("""
      <mujoco><asset><mesh name="box" vertex="-1 -1 -1 1 -1 -1 1 1 -1 -1 1 -1
          -1 -1 1 1 -1 1 1 1 1 -1 1 1"
          scale=".3 .3 .3"/></asset>
      <worldbody><geom type="mesh" mesh="box"/><camera name="eye" pos="0 0 2"/></worldbody></mujoco>""")
    flat = np.asarray(_draw(box, forward(box)).normal)
    np.testing.assert_allclose(flat[SIZE[0] // 2, SIZE[1] // 2], [0, 0, 1], atol=1e-5)


@pytest.mark.parametrize("light", [mjtLightType.mjLIGHT_DIRECTIONAL, mjtLightType.mjLIGHT_POINT], ids=lambda x: x.name)
def test_shadows_of_meshes_equal_mj_ray_towards_the_light(light: mjtLightType) -> None:
    errors = []
    for seed in SHADOW_SEEDS:
        model = random_scene(np.random.default_rng(seed), num_geoms=5, light=light, num_meshes=5)
        data = forward(model)
        is_white = np.asarray(_draw(model, data).rgb)[..., 0] > 0.5
        points, ids = cast_points(model, data, 0, SIZE)
        is_reached = reached_by_light(model, data, points, ids)
        # mj_ray ignores the body of the pixel's geom. But a mesh that is not convex casts shadows on itself.
        is_face = np.isin(model.geom_type[ids], (mjtGeom.mjGEOM_MESH, mjtGeom.mjGEOM_HFIELD))
        is_clear = (ids >= 0) & ~is_face & ~on_outline(ids) & ~on_outline(is_reached)
        errors.append(np.mean((is_white != is_reached)[is_clear]))
    # A cell of the shadow map is about as large as a pixel, so a few pixels near shadow edges may differ.
    assert np.max(errors[:-1]) < 2e-3
    assert errors[-1] < 3e-3
    assert np.mean(errors) < 1e-3


def test_mesh_casts_shadows_on_itself() -> None:
    light = '<light type="directional" dir="-1 .3 -.6" ambient="0 0 0" diffuse="1 1 1" specular="0 0 0"/>'
    model = _mesh_model(light=light)
    model.vis.headlight.active = 0
    data = forward(model)
    image, to_light = _draw(model, data), -data.light_xdir[0]
    points, ids = cast_points(model, data, 0, SIZE)
    normal = np.asarray(image.normal, np.float64)
    starts = points + 2e-3 * normal
    is_reached = np.ones(SIZE, bool)
    for pixel in zip(*np.nonzero(ids >= 0), strict=True):
        is_reached[pixel] = mujoco.mj_ray(model, data, starts[pixel], to_light, None, True, -1, None) < 0.0
    is_facing = normal @ to_light > 0.3
    is_clear = (ids >= 0) & is_facing & ~on_outline(ids) & ~on_outline(is_reached)
    is_lit = np.asarray(image.rgb)[..., 0] > 0.1
    assert 0.02 < (~is_reached & is_clear).sum() / is_clear.sum() < 0.6
    assert np.mean((is_lit != is_reached)[is_clear]) < 0.02


def test_gradients_of_a_mesh_equal_central_differences() -> None:
    model = _mesh_model()
    data = forward(model)
    frames, scene = poses(model, data), render.compile_scene(model)
    eye, direction = render.camera(frames, model, "eye"), jnp.array([0.3, -0.5, 0.8])

    def draw(position: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        image = render.render(scene, frames, eye.replace(position=position), size=(24, 24))
        return jnp.where(image.geom_id >= 0, image.depth, 0.0), image.rgb, image.geom_id

    step = 2e-3
    ends = jax.jit(jax.vmap(draw))(eye.position[None] + step * jnp.array([[-1.0], [1.0]]) * direction[None])
    (_, _, ids), (depth_rate, rgb_rate, _) = jax.jit(lambda p: jax.jvp(draw, (p,), (direction,)))(eye.position)
    assert bool(jnp.all(jnp.isfinite(depth_rate))) and bool(jnp.all(jnp.isfinite(rgb_rate)))
    interior = ~on_outline(np.asarray(ids)) & (np.asarray(ids) >= 0)
    for value, rate in ((ends[0], depth_rate), (ends[1], rgb_rate)):
        difference = np.asarray((value[1] - value[0]) / (2 * step))[interior]
        error = np.abs(np.asarray(rate)[interior] - difference)
        # If the ray moves to another face within the step, the difference is a mean of both faces.
        assert np.mean(error < 0.02 + 0.05 * np.abs(difference)) > 0.85
