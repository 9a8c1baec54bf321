"""Closed meshes and height fields whose edges run through pixel centres have no holes."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mujoco import mjtGeom

from oracles.render import cast_image, forward, look_at, on_outline
from vsearch_jax import render
from vsearch_jax.types import Camera

SIZE = (96, 96)
# Orientations of a camera that looks straight at one side of a cube, with the image upright or rotated by 90 degrees.
SIDES = [
    np.stack([right, np.cross(backward, right), backward], axis=1)
    for axis in range(3)
    for backward in (np.eye(3)[axis], -np.eye(3)[axis])
    for right in (np.eye(3)[(axis + 1) % 3],)
]


def _grid_box(count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Returns vertices f64[V, 3] and faces i32[F, 3] of the cube from -1 to 1, each side split into count^2 squares.

    Sides share no vertices, as in STL files. Faces are in random order and begin at a random corner.
    """
    ticks, vertices, faces = np.linspace(-1.0, 1.0, count + 1), [], []
    for axis in range(3):
        for sign in (-1.0, 1.0):
            index = len(vertices) * (count + 1) ** 2 + np.arange((count + 1) ** 2).reshape(count + 1, count + 1)
            side = np.stack([np.full((count + 1,) * 2, sign), *np.meshgrid(ticks, ticks, indexing="ij")], axis=-1)
            vertices.append(np.roll(side, axis, axis=-1).reshape(-1, 3))
            squares = np.stack([index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]], axis=-1).reshape(-1, 4)
            for square in squares if sign > 0.0 else squares[:, ::-1]:
                square = np.roll(square, rng.integers(4))
                faces += [np.roll(square[[0, i, i + 1]], rng.integers(3)) for i in (1, 2)]
    return np.concatenate(vertices), rng.permutation(np.array(faces))


def _models(rng: np.random.Generator) -> tuple[mujoco.MjModel, mujoco.MjModel]:
    """Returns a model of a cube mesh and a flat height field, and one with the same solids as boxes."""
    edge = rng.choice([0.1, 0.125, 0.11])
    vertices, faces = _grid_box(6, rng)
    spec, boxes = mujoco.MjSpec(), mujoco.MjSpec()
    spec.add_mesh(name="cube", uservert=(edge * vertices).ravel(), userface=faces.ravel())
    spec.add_hfield(name="flat", nrow=7, ncol=9, size=[0.12, 0.08, 0.1, 0.2], userdata=np.zeros(63))
    spec.worldbody.add_geom(type=mjtGeom.mjGEOM_MESH, meshname="cube")
    spec.worldbody.add_geom(type=mjtGeom.mjGEOM_HFIELD, hfieldname="flat", pos=[2, 0, 0.1])
    boxes.worldbody.add_geom(type=mjtGeom.mjGEOM_BOX, size=[edge] * 3)
    boxes.worldbody.add_geom(type=mjtGeom.mjGEOM_BOX, size=[0.12, 0.08, 0.1], pos=[2, 0, 0])
    for own in (spec, boxes):
        for _ in range(24):
            own.worldbody.add_camera(fovy=45)
    return spec.compile(), boxes.compile()


def _look_from_all_sides(models: tuple[mujoco.MjModel, ...], rng: np.random.Generator) -> None:
    """Places cameras 0-11 straight in front of the six sides of both solids, and the others at random."""
    for index in range(24):
        target, distance = np.array([2.0 * (index % 2), 0.0, 0.0]), rng.choice([0.8, 1.0, 1.1])
        if index < 12:
            matrix, quaternion = SIDES[index // 2], np.zeros(4)
            mujoco.mju_mat2Quat(quaternion, np.ascontiguousarray(matrix).reshape(9))
            eye = target + distance * matrix[:, 2]
        else:
            offset = rng.normal(size=3)
            eye = target + distance * offset / np.linalg.norm(offset)
            quaternion = look_at(eye, target)
        for model in models:
            model.cam_pos[index], model.cam_quat[index] = eye, quaternion


@pytest.mark.parametrize("num_scenes", [1, pytest.param(11, marks=pytest.mark.slow)])
def test_shared_edges_have_no_holes(num_scenes: int) -> None:
    @jax.jit
    def draw(scene: render.RenderScene, frames: render.Poses, cameras: Camera) -> render.Image:
        return jax.vmap(lambda camera: render.render(scene, frames, camera, SIZE))(cameras)

    for seed in range(num_scenes):
        rng = np.random.default_rng(seed)
        model, boxes = _models(rng)
        _look_from_all_sides((model, boxes), rng)
        data, box_data = forward(model), forward(boxes)
        frames = render.poses(data)
        positions, rotations = frames.cam_xpos, frames.cam_xmat
        cameras = Camera(positions, rotations, jnp.full(len(positions), np.deg2rad(45.0), jnp.float32))
        images = draw(render.compile_scene(model), frames, cameras)
        for index in range(24):
            depth, ids = cast_image(boxes, box_data, index, SIZE)
            is_clear = ~on_outline(ids)
            assert (ids >= 0).sum() > 200
            np.testing.assert_array_equal(np.asarray(images.geom_id[index])[is_clear], ids[is_clear])
            np.testing.assert_allclose(np.asarray(images.depth[index])[is_clear], depth[is_clear], rtol=1e-4)
