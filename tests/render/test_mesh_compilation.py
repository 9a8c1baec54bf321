"""Which back faces are left out, what geoms share, and which of two geoms in one place is drawn."""

from __future__ import annotations

import jax
import mujoco
import numpy as np
import pytest
import trimesh
from mujoco import mjtGeom

from oracles.render import cast_image, forward, on_outline
from vsearch_jax import render
from vsearch_jax.render.geometry.solids import bounds_solids

SIZE = (48, 64)


def _pushed_through() -> trimesh.Trimesh:
    """Returns a closed sphere whose top is pushed through its bottom, so that its inside is seen from below."""
    sphere = trimesh.creation.icosphere(3)
    vertices, top = sphere.vertices.copy(), sphere.vertices[:, 2] > 0.6
    vertices[top, 2] -= 2.6 * (vertices[top, 2] - 0.6) / 0.4
    return trimesh.Trimesh(vertices, sphere.faces, process=False)


def _moved(mesh: trimesh.Trimesh, x: float) -> trimesh.Trimesh:
    return trimesh.Trimesh(mesh.vertices + np.array([x, 0.2, 0.3]), mesh.faces, process=False)


@pytest.mark.parametrize(
    ("mesh", "expected"),
    [
        (trimesh.creation.box(), True),
        (trimesh.creation.icosphere(3), True),
        (trimesh.creation.torus(1.0, 0.3), True),
        (trimesh.creation.cylinder(1.0, 2.0, sections=200), True),
        (trimesh.creation.annulus(0.5, 1.0, 2.0), True),
        (trimesh.util.concatenate([trimesh.creation.box(), _moved(trimesh.creation.box(), 1.0)]), True),
        (trimesh.util.concatenate([trimesh.creation.icosphere(), _moved(trimesh.creation.icosphere(), 0.7)]), True),
        (trimesh.creation.icosphere(2).submesh([range(300)], append=True), False),
        (_pushed_through(), False),
    ],
    ids=["box", "sphere", "torus", "cylinder", "tube", "touching", "overlapping", "open", "pushed through"],
)
def test_back_faces_are_left_out_of_sound_solids_only(mesh: trimesh.Trimesh, expected: bool) -> None:
    rotation = trimesh.transformations.random_rotation_matrix(np.random.default_rng(2).uniform(size=3))[:3, :3]
    assert bounds_solids(np.asarray(mesh.triangles)) == expected
    assert bounds_solids(np.asarray(mesh.triangles) @ rotation.T) == expected
    if expected:
        assert not bounds_solids(np.asarray(mesh.triangles)[:, ::-1])


def test_a_crossing_mesh_and_shared_assets_equal_mj_multi_ray() -> None:
    mesh, spec, rng = _pushed_through(), mujoco.MjSpec(), np.random.default_rng(3)
    shell = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
    spec.add_mesh(name="m", uservert=0.2 * mesh.vertices.ravel(), userface=mesh.faces.ravel(), inertia=shell)
    spec.add_hfield(name="h", nrow=6, ncol=7, size=[0.2, 0.3, 0.1, 0.05], userdata=rng.uniform(size=42))
    world, field = spec.worldbody, mjtGeom.mjGEOM_HFIELD
    for position, tilt in (([-0.3, 0, 0.3], [0, 0.6, 0.8, 0]), ([0.3, 0.1, 0.3], [0.1, 0.9, -0.2, 0.1])):
        world.add_geom(type=mjtGeom.mjGEOM_MESH, meshname="m", pos=position, quat=tilt)
        world.add_geom(type=field, hfieldname="h", pos=[position[0], 0.3, 0.1], quat=[0.9, 0.2, 0.1, position[0]])
    world.add_camera(name="eye", pos=[0, 0.1, 1.6], fovy=50)
    model = spec.compile()
    scene = render.compile_scene(model)
    assert scene.triangles is not None
    num_faces = model.mesh_facenum[0] + 2 * 5 * 6 + 4 * (5 + 6) + 2
    assert scene.triangles.corners.shape[2] == scene.triangles.surface.shape[1] == num_faces
    assert scene.triangles.geom.shape == (2 * num_faces,)
    data = forward(model)
    frames = render.poses(data)
    camera = render.camera(frames, model, "eye")
    image = jax.jit(render.render, static_argnames="size")(scene, frames, camera, size=SIZE)
    depth, ids = cast_image(model, data, 0, SIZE)
    assert len(np.unique(ids)) == 5
    is_clear = ~on_outline(ids)
    np.testing.assert_array_equal(np.asarray(image.geom_id)[is_clear], ids[is_clear])
    error = np.abs(np.asarray(image.depth)[is_clear & (ids >= 0)] / depth[is_clear & (ids >= 0)] - 1.0)
    assert np.quantile(error, 0.995) < 1e-4  # the others are on the crossing's edge


TWINS = """
<mujoco><asset>
  <mesh name="a" vertex="0 0 0 1 0 0 0 1 0 0 0 1"/><mesh name="b" vertex="0 0 0 1 0 0 0 1 0 0 0 1"/>
</asset><worldbody>
  <geom name="table_visual" type="box" size=".3 .3 .1" group="1"/>
  <geom name="table_collision" type="box" size=".3 .3 .1" group="0"/>
  <geom name="first" size=".1" pos="1 0 0"/><geom name="second" size=".1" pos="1 0 0" quat="0 1 0 0"/>
  <geom name="other_size" size=".11" pos="1 0 0"/>
  <body name="b" pos="0 2 0"><freejoint/>
    <geom name="mesh_collision" type="mesh" mesh="a" group="2" rgba="1 0 0 .3"/>
    <body><geom name="mesh_visual" type="mesh" mesh="b"/></body>
    <geom name="joint_box" type="box" size=".3 .3 .1" pos="0 -2 0"/>
  </body>
  <body mocap="true"><geom name="mocap_box" type="box" size=".3 .3 .1"/></body>
</worldbody></mujoco>"""


def test_of_geoms_in_one_place_the_higher_group_is_drawn_then_the_higher_id() -> None:
    model = mujoco.MjModel.from_xml_string(TWINS)
    names = {model.geom(geom).name for geom in render.compile_scene(model).geom_ids}
    expected = {"table_visual", "second", "other_size", "mesh_visual", "joint_box", "mocap_box"}
    assert names == expected
    assert "table_collision" in {model.geom(g).name for g in render.compile_scene(model, geom_groups=(0,)).geom_ids}
