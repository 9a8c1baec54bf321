"""Pairs that always touch are named with their remedy, and the remedy helps."""

import re

import mujoco
import pytest

from vsearch_jax.config import SceneConfig
from vsearch_jax.robot.blocking import describe_blocking_contacts
from vsearch_jax.scene import build_scene

# The box of link `b` reaches into link `root`, its parent's parent.
ARM = """
<mujoco>
  <worldbody>
    <body name="root" pos="0 0 {lift}">
      <joint name="first" axis="0 0 1" range="-170 170"/>
      <geom name="shell" type="box" size="0.04 0.04 0.06" pos="0 0 0.05"/>
      <body name="a" pos="0 0 0.15">
        <joint axis="0 0 1" range="-170 170"/>
        <geom type="sphere" size="0.01"/>
        <body name="b">
          <joint axis="0 0 1" range="-170 170"/>
          <geom name="core" type="box" size="0.02 0.02 0.06"/>
          <site name="tcp"/>
          <camera name="wrist" quat="0 1 0 0" {mode}/>
        </body>
      </body>
    </body>
  </worldbody>
  {contact}
</mujoco>
"""


def _scene(tmp_path, contact: str = "", lift: float = 0.02, mode: str = ""):
    path = tmp_path / "arm.xml"
    path.write_text(ARM.format(contact=contact, lift=lift, mode=mode))
    return build_scene(SceneConfig(arm=str(path)))


def test_the_exclude_line_of_the_message_ends_the_contact(tmp_path):
    text = describe_blocking_contacts(_scene(tmp_path))
    assert "geom 'core' of body 'b' and geom 'shell' of body 'root'" in text or "'shell' of body 'root'" in text
    line = re.search(r"<contact>.*</contact>", text)
    assert line is not None
    assert describe_blocking_contacts(_scene(tmp_path, line.group())) == ""


def test_a_link_below_the_base_touches_the_mount_until_the_base_is_raised(tmp_path):
    excluded = '<contact><exclude body1="root" body2="b"/></contact>'
    text = describe_blocking_contacts(_scene(tmp_path, excluded, lift=0.0))
    assert "geom 'shell' of body 'root' and geom 'mount_plate' of the scene's mount" in text
    height = re.search(r"raise the base by at least ([\d.]+) m", text)
    assert height is not None and float(height.group(1)) == pytest.approx(0.015)
    assert describe_blocking_contacts(_scene(tmp_path, excluded, lift=float(height.group(1)))) == ""


@pytest.mark.parametrize("mode", ["targetbody", "targetbodycom", "track", "trackcom"])
def test_a_wrist_camera_that_is_not_fixed_to_its_body_is_refused(tmp_path, mode):
    with pytest.raises(ValueError, match=f"camera 'wrist' has mode '{mode}'.*remove `mode`"):
        _scene(tmp_path, mode=f'mode="{mode}" target="root"' if "target" in mode else f'mode="{mode}"')


def test_an_arm_that_can_touch_nothing_is_logged(tmp_path, caplog):
    path = tmp_path / "arm.xml"
    text = ARM.format(contact="", lift=0.02, mode="").replace("<worldbody>", "<worldbody>", 1)
    path.write_text(text.replace("<mujoco>", '<mujoco><default><geom contype="0" conaffinity="0"/></default>', 1))
    build_scene(SceneConfig(arm=str(path)))
    assert "contype and conaffinity of all moving geoms are 0" in caplog.text


def test_the_library_counts_contacts_as_c_mujoco_does(tmp_path):
    scene = _scene(tmp_path)
    data = mujoco.MjData(scene.mj_model)
    mujoco.mj_forward(scene.mj_model, data)
    assert any(c.dist < 0.0 for c in data.contact)
