"""A file of a scene that was edited after the training is noticed and named."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

from vsearch_jax.config import EnvConfig, SceneConfig
from vsearch_jax.scene import SceneError, check_unchanged, scene_fingerprint

ARM = """<mujoco><compiler meshdir="assets" texturedir="assets"/><include file="parts/actuators.xml"/>
<asset>
  <mesh name="link" file="link.stl"/><texture name="skin" type="2d" file="skin.png"/>
  <material name="skin" texture="skin"/><hfield name="ground" file="ground.png" size="1 1 .1 .1"/>
</asset>
<worldbody><body name="base">
  <joint name="j" axis="0 0 1" range="-1 1"/><geom type="mesh" mesh="link" material="skin"/>
  <geom type="hfield" hfield="ground"/><camera name="wrist" pos="0 0 1"/><site name="tcp"/>
</body></worldbody></mujoco>"""
ACTUATORS = '<mujoco><actuator><position joint="j" kp="10"/></actuator></mujoco>'
KINEMATIC, DYNAMIC = EnvConfig(), EnvConfig(motion="dynamic", reachable="path")


@pytest.fixture
def scene(tmp_path: Path) -> SceneConfig:
    """Returns a scene whose arm has an included file, a mesh, a texture and a height field; the object is an OBJ."""
    (tmp_path / "assets").mkdir()
    (tmp_path / "parts").mkdir()
    (tmp_path / "arm.xml").write_text(ARM)
    (tmp_path / "parts" / "actuators.xml").write_text(ACTUATORS)
    trimesh.creation.box().export(tmp_path / "assets" / "link.stl")
    for name, shape in (("assets/skin.png", (4, 4, 3)), ("assets/ground.png", (4, 4)), ("my colour.png", (4, 4, 3))):
        save_image(tmp_path / name, np.arange(np.prod(shape)).reshape(shape))
    vertices = "".join(f"v {x} {y} {z}\n" for x, y, z in np.eye(4, 3))
    (tmp_path / "part.obj").write_text(f"mtllib part.mtl\n{vertices}f 1 2 3\nf 1 2 4\nf 2 3 4\nf 3 1 4\n")
    (tmp_path / "part.mtl").write_text("newmtl a\nmap_Kd -s 1 1 my colour.png\nmap_Ks my colour.png\n")
    return SceneConfig(arm=str(tmp_path / "arm.xml"), object=str(tmp_path / "part.obj"))


def save_image(path: Path, pixels: np.ndarray) -> None:
    Image.fromarray(pixels.astype(np.uint8)).save(path)


def replace(old: str, new: str) -> Callable[[Path], object]:
    def edit(path: Path) -> None:
        text = path.read_text()
        assert old in text
        path.write_text(text.replace(old, new))

    return edit


@pytest.mark.parametrize(
    ("part", "file", "edit"),
    [
        ("arm", "arm.xml", replace('range="-1 1"', 'range="-1 2"')),
        ("arm", "arm.xml", replace('name="wrist" pos', 'name="other" pos')),
        ("arm", "assets/link.stl", lambda path: trimesh.creation.box((1, 1, 2)).export(path)),
        ("arm", "assets/skin.png", lambda path: save_image(path, np.ones((4, 4, 3)))),
        ("arm", "ground.png", lambda path: save_image(path.parent / "assets/ground.png", np.eye(4))),
        ("object", "part.obj", replace("f 1 2 3\n", "")),
        ("object", "part.mtl", replace("newmtl a", "newmtl a\nKd 1 0 0")),
        ("object", "my colour.png", lambda path: save_image(path, np.ones((4, 4, 3)))),
    ],
)
def test_an_edited_file_is_named(
    scene: SceneConfig, tmp_path: Path, part: str, file: str, edit: Callable[[Path], object]
) -> None:
    before = scene_fingerprint(scene, KINEMATIC)
    check_unchanged(scene, KINEMATIC, before)
    edit(tmp_path / file)
    with pytest.raises(SceneError) as error:
        check_unchanged(scene, KINEMATIC, before)
    message = str(error.value)
    assert message.startswith(f"{part} file ") and f"(changed: {file}" in message and "restore the files" in message
    assert "another folder" in message and "\n" not in message


@pytest.mark.parametrize(
    "edit",
    [
        replace("<asset>", "<!-- a comment -->\n<asset>"),
        replace('<joint name="j"', '<joint name="j" user="1.7"'),
        replace("<asset>", '<default><joint user="1.7" damping="3"/></default><asset>'),
    ],
)
def test_comments_and_speed_limits_may_be_added(
    scene: SceneConfig, tmp_path: Path, edit: Callable[[Path], object]
) -> None:
    before = scene_fingerprint(scene, KINEMATIC)
    edit(tmp_path / "arm.xml")
    check_unchanged(scene, KINEMATIC, before)


def test_actuators_count_with_dynamic_motion_only(scene: SceneConfig, tmp_path: Path) -> None:
    before = {motion: scene_fingerprint(scene, motion) for motion in (KINEMATIC, DYNAMIC)}
    replace('kp="10"', 'kp="20"')(tmp_path / "parts" / "actuators.xml")
    check_unchanged(scene, KINEMATIC, before[KINEMATIC])
    with pytest.raises(SceneError, match=r"changed: .*parts/actuators\.xml"):
        check_unchanged(scene, DYNAMIC, before[DYNAMIC])


def test_a_run_without_fingerprint_is_accepted_and_one_with_another_arm_of_the_package_is_not() -> None:
    scene = SceneConfig()
    check_unchanged(scene, KINEMATIC, {})
    before = scene_fingerprint(scene, KINEMATIC)
    before["arm"] = {"files": {"lwr.xml": "another"}, "model": "another"}
    with pytest.raises(SceneError, match="install the version of vsearch_jax with which it was trained"):
        check_unchanged(scene, KINEMATIC, before)
