"""Faulty files and unknown names raise SceneError with one line that names the file and the remedy."""

import re

import pytest

from samples.second_arm import MJCF
from vsearch_jax.config import SceneConfig
from vsearch_jax.scene import SceneError, build_scene, xml_folder


@pytest.mark.parametrize(
    ("part", "content", "words"),
    [
        ("object", None, ["object", "does not exist", "teapot"]),
        ("arm", None, ["arm", "does not exist", "lwr"]),
        ("object", "<mujoco><worldbody/></mujoco>", ["has no geom"]),
        ("object", "<mujoco><world/></mujoco>", ["cannot be loaded", "unrecognized element"]),
        ("arm", MJCF.replace('name="tcp"', ""), ["no site named 'tcp'"]),
        ("arm", MJCF.replace('<camera name="wrist"', '<camera name="eye"'), ["no camera named 'wrist'"]),
        (
            "arm",
            '<mujoco><worldbody><body><geom size="1"/><site name="tcp"/><camera name="wrist"/></body></worldbody>'
            "</mujoco>",
            ["no joint that moves the camera"],
        ),
        (
            "arm",
            '<mujoco><worldbody><body><freejoint name="fly"/><geom size="1"/><site name="tcp"/><camera name="wrist"/>'
            "</body></worldbody></mujoco>",
            ["'fly'", "is a free joint or a ball joint"],
        ),
    ],
)
def test_a_faulty_file_raises_an_error_of_one_line(tmp_path, part, content, words):
    path = tmp_path / "file.xml"
    if content is not None:
        path.write_text(content)
    with pytest.raises(SceneError) as caught:
        build_scene(SceneConfig(**{part: str(path)}))
    message = str(caught.value)
    assert "\n" not in message
    for word in [str(path), *words]:
        assert word in message


def test_a_plane_that_the_arm_could_touch_is_rejected(tmp_path):
    path = tmp_path / "wall.xml"
    wall = '<mujoco><worldbody><geom name="wall" type="plane" size="1 1 .1" pos="1 0 0" {bits}/></worldbody></mujoco>'
    path.write_text(wall.format(bits=""))
    with pytest.raises(SceneError, match=r"geom 'obstacle/wall' .* is a plane.*make it a box"):
        build_scene(SceneConfig(obstacles=str(path)))
    path.write_text(wall.format(bits='contype="0" conaffinity="0"'))
    assert len(build_scene(SceneConfig(obstacles=str(path))).obstacle_geom_ids) == 1


def test_a_wrist_camera_without_a_centred_square_sensor_is_rejected(tmp_path):
    path = tmp_path / "arm.xml"
    text = (xml_folder() / "arm" / "lwr.xml").read_text()
    for attributes, is_valid in (
        ('projection="orthographic"', False),
        ('focal=".01 .01" sensorsize=".008 .006" resolution="64 48"', False),
        ('focal=".01 .01" sensorsize=".006 .006" principal=".001 0" resolution="64 64"', False),
        ('focal=".01 .01" sensorsize=".006 .006" resolution="64 64"', True),
    ):
        path.write_text(re.sub(r'(<camera name="wrist"[^>]*?) fovy="[^"]*"', rf"\1 {attributes}", text))
        if is_valid:
            assert build_scene(SceneConfig(arm=str(path))).mj_model.ncam
        else:
            with pytest.raises(SceneError, match="camera 'wrist' is orthographic or its sensor"):
                build_scene(SceneConfig(arm=str(path)))


def test_a_faulty_mesh_and_an_unknown_name_raise_an_error(tmp_path):
    path = tmp_path / "part.stl"
    path.write_text("no mesh")
    with pytest.raises(SceneError, match=r"part\.stl.*cannot be loaded"):
        build_scene(SceneConfig(object=str(path)))
    with pytest.raises(SceneError, match=r"SceneConfig\.object is 'teepot'; available: bracket, teapot, truck"):
        build_scene(SceneConfig(object="teepot"))
    with pytest.raises(SceneError, match=r"SceneConfig\.arm is 'kuka'; available: lwr, ur5e"):
        build_scene(SceneConfig(arm="kuka"))


@pytest.mark.parametrize(
    "name",
    ["part.step", "part.STP", "part.iges", "part.fbx", "part.usdz", "part.sldprt", "part.blend", "part.3ds", "part."],
)
def test_a_format_that_cannot_be_read_is_named_with_those_that_can(tmp_path, name):
    path = tmp_path / name
    path.write_bytes(b"ISO-10303-21;")
    with pytest.raises(SceneError, match=r"the format '.*' cannot be read; give MJCF .*STL.*GLB.*export"):
        build_scene(SceneConfig(object=str(path)))


@pytest.mark.parametrize("part", ["arm", "obstacles"])
def test_a_mesh_in_place_of_a_model_is_refused_with_a_remedy(tmp_path, part):
    path = tmp_path / "part.stl"
    path.write_bytes(bytes(84))
    with pytest.raises(SceneError, match=rf"{part} file .*format '.stl' cannot be read; give MJCF .* name mesh files"):
        build_scene(SceneConfig(**{part: str(path)}))


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("part.glb", b"glTF" + bytes(40), "no glTF 2.0 file.*export it again"),
        ("part.gltf", b"{", "no glTF 2.0 file.*export it again"),
        ("part.gltf", b"[]", "no glTF 2.0 file; export it again"),
        (
            "part.gltf",
            b'{"asset": {"version": "2.0"}, "extensionsUsed": ["KHR_draco_mesh_compression"]}',
            r"compressed \(Draco\); export it without mesh compression",
        ),
        ("part.3mf", b"no archive", "no 3MF file.*export it again"),
        ("part.dae", b"no xml", "not a readable mesh.*export it again|no COLLADA file.*export it again"),
        ("part.msh", b"$MeshFormat", "no MSH file of MuJoCo.*export it as OBJ, STL or GLB"),
        ("part.obj", b"v 0 0 0\nv 1 0 0\n", "no triangle; export a surface"),
        ("part.obj", b"v 0 0 0\nv .1 0 0\nv 0 .1 nan\nf 1 2 3\n", "not finite; repair it"),
    ],
)
def test_a_damaged_mesh_file_is_refused_with_a_remedy(tmp_path, name, content, words):
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(SceneError, match=rf"object file '.*{name}' cannot be loaded: .*{words}") as caught:
        build_scene(SceneConfig(object=str(path)))
    assert "\n" not in str(caught.value)


FLEX = """<mujoco><worldbody><body name="soft"><geom size="0.01"/><flexcomp name="cloth" type="grid" count="3 3 1"
spacing=".02 .02 .02" radius=".001" mass=".1"><edge equality="true"/></flexcomp></body></worldbody></mujoco>"""


@pytest.mark.parametrize("part", ["object", "obstacles"])
def test_a_flex_is_refused_by_name_and_by_the_file_that_holds_it(tmp_path, part):
    path = tmp_path / "soft.xml"
    path.write_text(FLEX)
    with pytest.raises(SceneError, match=rf"{part} file '.*soft\.xml': flex 'cloth' .*; replace it by a mesh geom"):
        build_scene(SceneConfig(**{part: str(path)}))


OBJECT_WITH_SYMMETRY = """<mujoco><custom><numeric name="symmetry" data="{data}"/></custom>
<worldbody><body><geom size="0.03"/></body></worldbody></mujoco>"""


@pytest.mark.parametrize(("data", "configured", "expected"), [("4", None, 4), ("0", None, 0), ("4", 2, 2)])
def test_the_symmetry_of_an_object_is_read_from_its_file_unless_the_config_gives_it(
    tmp_path, data, configured, expected
):
    path = tmp_path / "part.xml"
    path.write_text(OBJECT_WITH_SYMMETRY.format(data=data))
    assert build_scene(SceneConfig(object=str(path), symmetry=configured)).symmetry == expected


def test_an_object_without_a_declaration_has_no_symmetry():
    assert build_scene(SceneConfig()).symmetry == 1


@pytest.mark.parametrize("data", ["-1", "2.5", "2 3"])
def test_a_symmetry_that_is_no_whole_number_raises_an_error(tmp_path, data):
    path = tmp_path / "part.xml"
    path.write_text(OBJECT_WITH_SYMMETRY.format(data=data))
    with pytest.raises(SceneError, match=r"part\.xml.*numeric 'symmetry' is .*; give one whole number"):
        build_scene(SceneConfig(object=str(path)))
