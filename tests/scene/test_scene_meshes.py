"""Mesh files of each format become objects on the table; faulty meshes are reported."""

import mujoco
import numpy as np
import pytest
import trimesh

from vsearch_jax.config import SceneConfig
from vsearch_jax.scene import Scene, SceneError, build_scene
from vsearch_jax.scene.meshes import inspect_mesh, read_mesh

TETRAHEDRON = """
v 1.0 2.0 3.0
v 1.1 2.0 3.0
v 1.0 2.05 3.0
v 1.0 2.0 3.07
f 1 3 2
f 1 2 4
f 2 3 4
f 1 4 3
"""


def _placed_vertices(scene: Scene) -> np.ndarray:
    """Returns the vertices of the object's mesh, f64[V, 3] m in world."""
    data = mujoco.MjData(scene.mj_model)
    mujoco.mj_forward(scene.mj_model, data)
    geom = scene.object_geom_ids[0]
    return scene.mj_model.mesh_vert @ data.geom_xmat[geom].reshape(3, 3).T + data.geom_xpos[geom]


def _as_bytes(exported: str | bytes) -> bytes:
    return exported.encode() if isinstance(exported, str) else exported


def test_a_mesh_is_centred_on_the_table(tmp_path):
    path = tmp_path / "part.obj"
    path.write_text(TETRAHEDRON)
    scene = build_scene(SceneConfig(object=str(path)))
    vertices = _placed_vertices(scene)
    np.testing.assert_allclose(vertices.min(axis=0), [-0.05, -0.025, 0], atol=1e-6)
    np.testing.assert_allclose(vertices.max(axis=0), [0.05, 0.025, 0.07], atol=1e-6)


@pytest.mark.parametrize("suffix", ["obj", "stl", "stl_ascii", "ply", "glb", "off"])
def test_meshes_of_all_formats_have_the_same_vertices_in_world(tmp_path, suffix, caplog):
    path = tmp_path / f"part.{suffix.removesuffix('_ascii')}"
    shape = trimesh.creation.box((0.1, 0.06, 0.04), transform=trimesh.transformations.translation_matrix((3, 4, 5)))
    path.write_bytes(_as_bytes(shape.export(file_type=suffix)))
    scene = build_scene(SceneConfig(object=str(path)))
    vertices = _placed_vertices(scene)
    np.testing.assert_allclose(vertices.min(axis=0), [-0.05, -0.03, 0], atol=1e-6)
    np.testing.assert_allclose(vertices.max(axis=0), [0.05, 0.03, 0.04], atol=1e-6)
    assert not caplog.records


def test_a_mesh_with_holes_is_accepted_and_reported(tmp_path, caplog):
    shape = trimesh.creation.box((0.1, 0.06, 0.04))
    faces = np.concatenate([shape.faces[1:], [[0, 0, 1]]])
    path = tmp_path / "part.ply"
    path.write_bytes(trimesh.Trimesh(shape.vertices, faces, process=False).export(file_type="ply"))
    assert (
        str(inspect_mesh(*read_mesh(path)))
        == "12 faces, 1 of them without area, 3 edges at holes, size 0.1 x 0.06 x 0.04"
    )
    build_scene(SceneConfig(object=str(path)))
    assert "3 edges at holes" in caplog.text


@pytest.mark.parametrize(
    ("size", "words"), [(85.0, "85 m long.*millimetres.*0.001"), (1e-3, "0.001 m long.*mesh_scale")]
)
def test_a_mesh_in_another_unit_raises_an_error_with_a_remedy(tmp_path, size, words):
    path = tmp_path / "part.stl"
    path.write_bytes(trimesh.creation.box((size, size, size)).export(file_type="stl"))
    with pytest.raises(SceneError, match=rf"part\.stl.*{words}"):
        build_scene(SceneConfig(object=str(path)))


@pytest.mark.parametrize("suffix", ["stl", "ply"])
def test_a_mesh_is_scaled_and_keeps_the_position_of_its_file(tmp_path, suffix):
    path = tmp_path / f"part.{suffix}"
    shape = trimesh.creation.box((100, 60, 40), transform=trimesh.transformations.translation_matrix((10, 20, 30)))
    path.write_bytes(_as_bytes(shape.export(file_type=suffix)))
    scene = build_scene(SceneConfig(object=str(path), mesh_scale=0.001, is_mesh_recentred=False))
    vertices = _placed_vertices(scene)
    np.testing.assert_allclose(vertices.min(axis=0), [-0.04, -0.01, 0.01], atol=1e-6)
    np.testing.assert_allclose(vertices.max(axis=0), [0.06, 0.05, 0.05], atol=1e-6)
