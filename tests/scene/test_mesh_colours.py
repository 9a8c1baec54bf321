"""Colours and textures of mesh files are those that trimesh reads; what is lost is named in a warning."""

import io
import json
import re

import mujoco
import numpy as np
import pytest
import trimesh
from PIL import Image
from trimesh.visual.material import PBRMaterial
from trimesh.visual.texture import TextureVisuals

from oracles.mesh_files import compare
from vsearch_jax import render
from vsearch_jax.config import SceneConfig
from vsearch_jax.scene import SceneError
from vsearch_jax.scene.files import load_object

RNG = np.random.default_rng(3)
PICTURE = Image.fromarray(RNG.integers(0, 256, (24, 40, 3), dtype=np.uint8))

TEXTURED_OBJ = """mtllib part.mtl
v 0 0 0
v .1 0 0
v .1 .06 .01
v 0 .06 0
v 0 0 .05
vt 0.1 0.2
vt 0.9 0.25
vt 0.8 1.4
vt 0 0.7
usemtl painted
f 1/1 3/3 2/2
f 1/1 4/4 3/3
usemtl green
f 1/1 2/2 5/3
f 3/1 4/2 5/3
"""
MATERIALS = "newmtl painted\nKd 0.2 0.2 0.2\nmap_Kd skin.png\nnewmtl green\nKd 0.1 0.8 0.25\n"


def _png(picture: Image.Image = PICTURE) -> bytes:
    file = io.BytesIO()
    picture.save(file, "png")
    return file.getvalue()


def _ball(subdivisions: int = 2) -> trimesh.Trimesh:
    return trimesh.creation.icosphere(subdivisions=subdivisions, radius=0.05)


def _write(path, mesh: trimesh.Trimesh | trimesh.Scene) -> None:
    content = mesh.export(file_type=path.suffix[1:])
    path.write_bytes(content.encode() if isinstance(content, str) else content)


def _uv(mesh: trimesh.Trimesh) -> np.ndarray:
    return mesh.vertices[:, :2] * 7.0 + 0.3


def test_the_texture_and_the_colours_of_an_obj_file_are_kept(tmp_path, caplog):
    path = tmp_path / "part.obj"
    path.write_text(TEXTURED_OBJ)
    (tmp_path / "part.mtl").write_text(MATERIALS)
    (tmp_path / "skin.png").write_bytes(_png())
    result = compare(path, SceneConfig(), is_y_up=False)
    assert result.num_faces == 4 and result.num_colours > 4 and result.colour_error < 0.05
    assert "these are not drawn" not in caplog.text
    model = load_object(path, SceneConfig()).compile()
    # The same file, read by MuJoCo itself, has the same texture coordinates at its painted faces.
    spec = mujoco.MjSpec()
    spec.add_mesh(name="m", file=str(path))
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname="m", contype=0, conaffinity=0, mass=0)
    own = spec.compile()
    painted = int(model.geom_dataid[np.flatnonzero(model.geom_matid >= 0)[0]])
    first = model.mesh_faceadr[painted]
    texcoords = model.mesh_texcoord[model.mesh_facetexcoord[first : first + 2] + model.mesh_texcoordadr[painted]]
    np.testing.assert_allclose(texcoords, own.mesh_texcoord[own.mesh_facetexcoord[:2]], atol=1e-6)


@pytest.mark.parametrize("suffix", ["ply", "glb"])
def test_vertex_colours_are_kept(tmp_path, suffix, caplog):
    mesh = _ball()
    mesh.visual.vertex_colors = np.uint8((0.5 + mesh.vertices * 9.0) * 255)
    path = tmp_path / f"part.{suffix}"
    _write(path, mesh)
    result = compare(path, SceneConfig(), is_y_up=suffix == "glb")
    assert result.num_colours > 500 and result.colour_error < 0.5
    assert "these are not drawn" not in caplog.text


@pytest.mark.parametrize(("num_colours", "num_geoms", "num_textures"), [(1, 1, 0), (3, 4, 0), (100, 1, 1)])
def test_face_colours_are_kept(tmp_path, num_colours, num_geoms, num_textures):
    mesh = _ball()
    palette = RNG.integers(0, 256, (num_colours, 3))
    mesh.visual.face_colors = palette[np.arange(len(mesh.faces)) % num_colours]
    path = tmp_path / "part.ply"
    _write(path, mesh)
    result = compare(path, SceneConfig(), is_y_up=False)
    # A texel on the border of two triangles has the colour of one.
    assert result.num_colours == num_colours and result.colour_error < (1.5 if num_textures else 1e-3)
    model = load_object(path, SceneConfig()).compile()
    assert (model.ngeom, model.ntex) == (num_geoms, num_textures)


def test_materials_of_a_glb_file_are_kept_at_their_nodes(tmp_path, caplog):
    scene, place = trimesh.Scene(), trimesh.transformations.rotation_matrix(0.7, (1, 2, 3))
    for material, shift in [
        (PBRMaterial(baseColorFactor=[200, 30, 60, 255], name="red"), 0.0),
        (PBRMaterial(baseColorTexture=PICTURE, name="skin"), 0.03),
        (PBRMaterial(baseColorTexture=PICTURE, baseColorFactor=[255, 128, 50, 255], name="tinted"), 0.06),
        (PBRMaterial(name="white"), 0.09),
    ]:
        mesh = trimesh.creation.box((0.02, 0.01, 0.03))
        mesh.visual = TextureVisuals(uv=_uv(mesh), material=material)
        place = place @ trimesh.transformations.translation_matrix((shift, 0, 0.5 * shift))
        scene.add_geometry(mesh, transform=place)
    path = tmp_path / "part.glb"
    _write(path, scene)
    result = compare(path, SceneConfig(), is_y_up=True)
    assert result.num_faces == 48 and result.num_colours > 20 and result.colour_error < 0.05
    model = load_object(path, SceneConfig()).compile()
    assert model.ntex == 2 and "these are not drawn" not in caplog.text
    # The arm avoids one invisible box around all four.
    box = model.geom("bounding_box")
    assert np.flatnonzero(model.geom_contype).tolist() == [box.id] and box.rgba[3] == 0.0
    np.testing.assert_allclose(2.0 * box.size, result.extents, atol=1e-6)


def test_a_file_without_colours_is_brown(tmp_path):
    path = tmp_path / "part.obj"
    path.write_text("v 0 0 0\nv .1 0 0\nv 0 .1 0\nv 0 0 .1\nvt 0 0\nf 1/1 3/1 2/1\nf 1/1 2/1 4/1\nf 2/1 3/1 4/1\n")
    model = load_object(path, SceneConfig()).compile()
    np.testing.assert_array_equal(model.geom_rgba, np.float32([[0.75, 0.55, 0.35, 1.0]]))
    assert model.nmat == 0


def test_painted_triangles_that_are_not_finite_are_refused_with_a_remedy(tmp_path):
    path = tmp_path / "part.obj"
    path.write_text("v 0 0 0 1 0 0\nv .1 0 0 0 1 0\nv 0 .1 nan 0 0 1\nv 0 0 .1 1 1 1\nf 1 2 3\nf 1 2 4\n")
    with pytest.raises(SceneError, match="not finite; repair it"):
        load_object(path, SceneConfig())


def _obj(tmp_path, obj: str = TEXTURED_OBJ, mtl: str = MATERIALS, image: bytes | None = None):
    (tmp_path / "part.mtl").write_text(mtl)
    (tmp_path / "skin.png").write_bytes(_png() if image is None else image)
    (tmp_path / "part.obj").write_text(obj)
    return tmp_path / "part.obj"


def _glb(tmp_path, material: PBRMaterial, colours: np.ndarray | None = None):
    mesh = _ball()
    mesh.visual = TextureVisuals(uv=_uv(mesh), material=material)
    if colours is not None:
        mesh.visual.vertex_attributes["color"] = colours
    _write(tmp_path / "part.glb", mesh)
    return tmp_path / "part.glb"


def _translucent(value: int) -> Image.Image:
    picture = PICTURE.convert("RGBA")
    picture.putalpha(value)
    return picture


LOSSES = {
    "library": (lambda t: _obj(t, TEXTURED_OBJ.replace("part.mtl", "none.mtl")), "file 'none.mtl'.*does not exist"),
    "image": (lambda t: _obj(t, mtl=MATERIALS.replace("skin", "none")), "the file 'none.png'.*does not exist"),
    "damaged": (lambda t: _obj(t, image=b"no image"), "the file 'skin.png' that it names, which is no readable image"),
    "cut": (lambda t: _obj(t, image=_png()[:200]), "textures whose image is damaged"),
    "material": (lambda t: _obj(t, mtl=MATERIALS.replace("green", "x")), "'green', which 'part.mtl' does not define"),
    "second": (lambda t: _obj(t, TEXTURED_OBJ + "mtllib b.mtl\n"), "library 'b.mtl', since only the first is read"),
    "opacity": (lambda t: _obj(t, mtl=MATERIALS + "d 0.5\n"), "transparency"),
    "alpha": (lambda t: _obj(t, image=_png(_translucent(90))), "transparency"),
    "blend": (
        lambda t: _glb(t, PBRMaterial(baseColorFactor=[1, 2, 3, 90], alphaMode="BLEND")),
        "not drawn: transparency$",
    ),
    "maps": (
        lambda t: _glb(t, PBRMaterial(normalTexture=PICTURE, emissiveFactor=[1.0, 0, 0])),
        "not drawn: normal maps; emission$",
    ),
    "painted": (
        lambda t: _glb(t, PBRMaterial(baseColorTexture=PICTURE), RNG.integers(0, 255, (162, 4), dtype=np.uint8)),
        "vertex colours of textured triangles",
    ),
}


@pytest.mark.parametrize("case", LOSSES)
def test_what_cannot_be_drawn_is_named_in_a_warning(tmp_path, caplog, case):
    write, words = LOSSES[case]
    load_object(write(tmp_path), SceneConfig())
    (record,) = [record for record in caplog.records if "these are not drawn" in record.message]
    assert record.levelname == "WARNING"
    assert re.search(words, record.message)


def test_an_opaque_material_with_alpha_gives_no_warning(tmp_path, caplog):
    load_object(_glb(tmp_path, PBRMaterial(baseColorTexture=_translucent(90))), SceneConfig())
    assert "these are not drawn" not in caplog.text


def test_points_and_lines_are_named_in_a_warning(tmp_path, caplog):
    scene = trimesh.Scene([_ball(), trimesh.PointCloud(RNG.random((5, 3)) * 0.1)])
    _write(tmp_path / "part.glb", scene)
    load_object(tmp_path / "part.glb", SceneConfig())
    assert "these are not drawn: points and lines" in caplog.text


def test_a_texture_beside_the_folder_and_in_gltf_is_found(tmp_path):
    mesh = _ball()
    mesh.visual = TextureVisuals(uv=_uv(mesh), material=PBRMaterial(baseColorTexture=PICTURE))
    (tmp_path / "meshes").mkdir()
    path = tmp_path / "meshes" / "part.gltf"
    for name, content in mesh.export(file_type="gltf").items():
        if name == "model.gltf":
            header = json.loads(content)
            header["images"] = [{"uri": "../skin.png"}]
            path.write_text(json.dumps(header))
        else:
            (tmp_path / "meshes" / name).write_bytes(content)
    (tmp_path / "skin.png").write_bytes(_png())
    model = load_object(path, SceneConfig()).compile()
    assert model.ntex == 1
    np.testing.assert_array_equal(model.tex_data, np.asarray(PICTURE).reshape(-1))


def test_materials_that_share_an_image_share_a_texture(tmp_path):
    copies = TEXTURED_OBJ.replace("usemtl green", "usemtl copy")
    path = _obj(tmp_path, copies, MATERIALS + "newmtl copy\nmap_Kd skin.png\n")
    model = load_object(path, SceneConfig()).compile()
    assert (model.ntex, model.ngeom, model.nmeshface) == (1, 1, 4)


@pytest.mark.slow
def test_painted_colours_are_rendered(tmp_path):
    mesh = _ball(4)
    mesh.visual.vertex_colors = np.uint8(255 * (0.5 + 0.45 * np.sin(40 * mesh.vertices + [0, 1, 2])) + 0.5)
    _write(tmp_path / "part.ply", mesh)
    spec = load_object(tmp_path / "part.ply", SceneConfig(is_mesh_recentred=False))
    light = spec.visual.headlight
    light.ambient, light.diffuse, light.specular = [1.0] * 3, [0.0] * 3, [0.0] * 3
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    camera = render.Camera(np.float32([0, 0, 0.35]), np.eye(3, dtype=np.float32), np.float32(0.4))
    image = render.render(render.compile_scene(model), render.poses(data), camera, (64, 64))
    hit, depth = np.asarray(image.geom_id) >= 0, np.asarray(image.depth)
    rows, columns = np.nonzero(hit)
    slope = 2.0 * np.tan(0.2) * (np.stack([columns, 63 - rows]) + 0.5 - 32) / 64
    points = np.stack([*(slope * depth[hit]), 0.35 - depth[hit]], axis=1)
    expected = 0.5 + 0.45 * np.sin(40 * points + [0, 1, 2])
    error = 255.0 * np.abs(np.asarray(image.rgb)[hit] - expected)
    assert hit.sum() > 800 and error.mean() < 1.0
