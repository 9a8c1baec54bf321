"""Mesh files of each format become objects on the table; faulty meshes are reported."""

import struct

import mujoco
import numpy as np
import pytest
import trimesh

from oracles.mesh_files import compare
from vsearch_jax.config import SceneConfig
from vsearch_jax.scene import Scene, SceneError, build_scene
from vsearch_jax.scene.files import load_object
from vsearch_jax.scene.meshes.checks import inspect_mesh

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


@pytest.mark.parametrize("suffix", ["obj", "stl", "stl_ascii", "ply", "off", "3mf", "glb", "gltf", "dae"])
def test_meshes_of_all_formats_have_the_same_vertices_in_world(tmp_path, suffix, caplog):
    path = tmp_path / f"part.{suffix.removesuffix('_ascii')}"
    shape = trimesh.creation.box((0.1, 0.06, 0.04), transform=trimesh.transformations.translation_matrix((3, 4, 5)))
    exported = shape.export(file_type=suffix)
    for name, content in exported.items() if isinstance(exported, dict) else [(path.name, exported)]:
        (path if name == "model.gltf" else tmp_path / name).write_bytes(_as_bytes(content))
    scene = build_scene(SceneConfig(object=str(path)))
    vertices = _placed_vertices(scene)
    # +y points up in glTF, and in COLLADA files that name no axis.
    is_y_up = suffix in ("glb", "gltf", "dae")
    np.testing.assert_allclose(vertices.min(axis=0), [-0.05, -0.02, 0] if is_y_up else [-0.05, -0.03, 0], atol=1e-6)
    np.testing.assert_allclose(vertices.max(axis=0), [0.05, 0.02, 0.06] if is_y_up else [0.05, 0.03, 0.04], atol=1e-6)
    assert ("y axis points up" in caplog.text) == is_y_up and len(caplog.records) == is_y_up


def test_a_collada_file_names_its_up_axis(tmp_path):
    path = tmp_path / "part.dae"
    content = trimesh.creation.box((0.1, 0.06, 0.04)).export(file_type="dae")
    path.write_bytes(content.replace(b"<up_axis>Y_UP", b"<up_axis>Z_UP"))
    assert b"Z_UP" in path.read_bytes()
    np.testing.assert_allclose(_placed_vertices(build_scene(SceneConfig(object=str(path)))).max(axis=0)[2], 0.04)


@pytest.mark.parametrize("up", ["x", "y", "z", "-x", "-y", "-z"])
def test_the_up_axis_of_the_config_is_turned_to_z_without_a_mirror(tmp_path, up, caplog):
    path = tmp_path / "part.obj"
    path.write_text(TETRAHEDRON)
    model = load_object(path, SceneConfig(mesh_up=up)).compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    a, b, c, d = model.mesh_vert[_by_file_order(model)] @ data.geom_xmat[0].reshape(3, 3).T + data.geom_xpos[0]
    edges = {"x": b - a, "y": c - a, "z": d - a}
    length = {"x": 0.1, "y": 0.05, "z": 0.07}[up[-1]]
    np.testing.assert_allclose(edges[up[-1]], [0, 0, -length if up[0] == "-" else length], atol=1e-6)
    assert np.linalg.det(np.stack([edges["x"], edges["y"], edges["z"]])) == pytest.approx(0.1 * 0.05 * 0.07, rel=1e-4)
    assert (f"its {up} axis points up" in caplog.text) == (up != "z")


def _by_file_order(model: mujoco.MjModel) -> list[int]:
    """Returns the rows of the tetrahedron's vertices 1 to 4, whose first faces are 1 3 2 and 1 2 4."""
    (a, c, b), (_, _, d) = model.mesh_face[0], model.mesh_face[1]
    return [int(a), int(b), int(c), int(d)]


def test_a_binary_stl_is_read_as_mujoco_reads_it(tmp_path):
    # The published runs on STL parts were trained on MuJoCo's own reading.
    path = tmp_path / "part.stl"
    shape = trimesh.creation.annulus(20.0, 35.0, 12.0).union(trimesh.creation.box((90, 20, 12)), engine="manifold")
    path.write_bytes(shape.export(file_type="stl"))
    model = load_object(path, SceneConfig(mesh_scale=0.001)).compile()
    spec = mujoco.MjSpec()
    inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
    spec.add_mesh(name="mesh", file=str(path), scale=[0.001] * 3, inertia=inertia)
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname="mesh", rgba=[0.75, 0.55, 0.35, 1.0])
    expected = spec.compile()
    for name in ("mesh_vert", "mesh_face", "mesh_normal", "mesh_facenormal", "mesh_pos", "mesh_quat", "geom_rgba"):
        np.testing.assert_array_equal(getattr(model, name), getattr(expected, name), err_msg=name)
    assert model.geom_matid[0] == -1 and model.nmeshtexcoord == 0


@pytest.mark.parametrize("suffix", ["obj", "stl", "ply", "glb", "dae", "3mf", "off"])
def test_all_parts_of_a_file_are_read_at_their_places(tmp_path, suffix, caplog):
    path = tmp_path / f"part.{suffix}"
    place = trimesh.transformations.compose_matrix(angles=(0.3, -0.8, 1.9), translate=(0.1, 0.05, 0.02))
    scene = trimesh.Scene()
    scene.add_geometry(trimesh.creation.icosphere(subdivisions=2, radius=0.03), node_name="ball")
    scene.add_geometry(trimesh.creation.box((0.02, 0.03, 0.05)), node_name="box", transform=place)
    rod = trimesh.creation.cylinder(0.01, 0.04, sections=12)
    if suffix == "glb":
        scene.add_geometry(rod, parent_node_name="box", transform=place)
    else:
        scene.add_geometry(rod, transform=place @ place)
    exported = scene if suffix in ("obj", "glb", "3mf") else scene.to_mesh()
    exported = scene.dump() if suffix == "dae" else exported
    export = trimesh.exchange.dae.export_collada if suffix == "dae" else lambda mesh: mesh.export(file_type=suffix)
    path.write_bytes(_as_bytes(export(exported)))
    result = compare(path, SceneConfig(object=str(path)), is_y_up=suffix in ("glb", "dae"))
    assert result.num_faces == result.num_faces_trimesh == 320 + 12 + 48
    np.testing.assert_allclose(result.extents, result.extents_trimesh, atol=1e-6)
    assert result.max_distance < 1e-5


def test_a_msh_file_of_mujoco_is_read(tmp_path):
    shape = trimesh.creation.box((0.1, 0.06, 0.04))
    path = tmp_path / "part.msh"
    # MuJoCo's XML reference, `mesh`: numbers of vertices, normals, texture coordinates and faces, then these.
    header = struct.pack("4i", len(shape.vertices), len(shape.vertices), 0, len(shape.faces))
    normals = np.float32(shape.vertex_normals).tobytes()
    path.write_bytes(header + np.float32(shape.vertices).tobytes() + normals + np.int32(shape.faces).tobytes())
    scene = build_scene(SceneConfig(object=str(path), mesh_up="y"))
    vertices = _placed_vertices(scene)
    np.testing.assert_allclose(vertices.min(axis=0), [-0.05, -0.02, 0], atol=1e-6)
    np.testing.assert_allclose(vertices.max(axis=0), [0.05, 0.02, 0.06], atol=1e-6)
    assert scene.mj_model.nmeshface == 12


def test_the_objects_and_groups_of_an_obj_file_are_all_read(tmp_path):
    path = tmp_path / "part.obj"
    second = "o second\nv 1.2 2 3\nv 1.25 2 3\nv 1.2 2.05 3\nv 1.2 2 3.05\nf 5 7 6\nf 5 6 8\ng end\nf 6 7 8\nf 5 8 7\n"
    path.write_text("o first" + TETRAHEDRON + second)
    model = load_object(path, SceneConfig()).compile()
    assert model.nmeshface == 8
    result = compare(path, SceneConfig(), is_y_up=False)
    np.testing.assert_allclose(result.extents, [0.25, 0.05, 0.07], atol=1e-6)


def test_a_mirrored_node_keeps_its_faces_outwards(tmp_path):
    path = tmp_path / "part.glb"
    scene = trimesh.Scene()
    mesh = trimesh.creation.icosphere(subdivisions=2, radius=0.03)
    assert mesh.vertex_normals is not None
    scene.add_geometry(mesh, transform=np.diag([1.0, -1.5, 1.0, 1.0]))
    path.write_bytes(scene.export(file_type="glb", include_normals=True))
    model = load_object(path, SceneConfig()).compile()
    corners, normals = model.mesh_vert[model.mesh_face], model.mesh_normal[model.mesh_facenormal]
    assert np.einsum("fx,fx->f", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])).sum() > 0
    assert np.einsum("fcx,fcx->fc", corners, normals).min() > 0


@pytest.mark.slow
def test_a_stl_of_more_faces_than_mujoco_reads_is_read(tmp_path):
    path = tmp_path / "part.stl"
    path.write_bytes(trimesh.creation.icosphere(subdivisions=7, radius=0.05).export(file_type="stl"))
    result = compare(path, SceneConfig(), is_y_up=False)
    assert result.num_faces == result.num_faces_trimesh == 327_680


@pytest.mark.parametrize("num_faces", [1, 2])
def test_a_flat_mesh_is_drawn_and_avoided_as_a_thin_box(tmp_path, num_faces):
    path = tmp_path / "plate.obj"
    path.write_text("v 0 0 0\nv .1 0 0\nv .1 .06 0\nv 0 .06 0\n" + "f 1 2 3\nf 1 3 4\n"[: 8 * num_faces])
    scene = build_scene(SceneConfig(object=str(path)))
    mesh, box = (scene.mj_model.geom(geom) for geom in scene.object_geom_ids)
    assert mesh.type == mujoco.mjtGeom.mjGEOM_MESH and scene.mj_model.nmeshface == num_faces
    assert box.type == mujoco.mjtGeom.mjGEOM_BOX and box.rgba[3] == 0 and box.group == 3
    np.testing.assert_allclose(box.size, [0.05, 0.03, 0.0005], atol=1e-6)
    assert (box.contype, mesh.contype, mesh.conaffinity) == (1, 0, 0)


def test_a_mesh_with_holes_is_accepted_and_reported(tmp_path, caplog):
    shape = trimesh.creation.box((0.1, 0.06, 0.04))
    faces = np.concatenate([shape.faces[1:], [[0, 0, 1]]])
    path = tmp_path / "part.ply"
    path.write_bytes(trimesh.Trimesh(shape.vertices, faces, process=False).export(file_type="ply"))
    words = "12 faces, 1 of them without area, 3 edges at holes, size 0.1 x 0.06 x 0.04"
    assert str(inspect_mesh(shape.vertices[faces])) == words
    build_scene(SceneConfig(object=str(path)))
    assert words in caplog.text


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
