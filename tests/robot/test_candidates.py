"""Which pairs of geoms count as pairs that can touch."""

import mujoco
import pytest

from vsearch_jax.robot.collision.candidates import Geoms, touching_pairs

# A disc turns on a fixed one. `{gap}` is between their faces. The pole beside them is near at qpos0 only.
FACE_TO_FACE = """<mujoco><worldbody>
  <body name="base"><geom name="base" type="cylinder" size="0.1 0.05" pos="0 0 0.05"/></body>
  <body name="turn" pos="0 0 {height:.12f}">
    <joint type="hinge" axis="0 0 1" range="-3 3" limited="true"/>
    <geom name="disc" type="cylinder" size="0.1 0.05" pos="0 0 0.05"/>
    <geom name="arm" type="box" size="0.1 0.02 0.02" pos="0.2 0 0.05"/>
  </body>
  <body><geom name="pole" type="box" size="0.02 0.02 0.2" pos="0.320001 0 0.2"/></body>
</worldbody></mujoco>"""


@pytest.mark.parametrize(("gap", "is_left_out"), [(1.5e-9, True), (5e-6, True), (-1e-6, False), (1e-3, False)])
def test_only_links_that_turn_face_to_face_without_contact_are_left_out(gap: float, is_left_out: bool) -> None:
    model = mujoco.MjModel.from_xml_string(FACE_TO_FACE.format(height=0.1 + gap))
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    ids = [model.geom(name).id for name in ("base", "disc", "arm")]
    geoms = Geoms(arm=tuple(ids), mount=(), object=(), obstacles=(model.geom("pole").id,))
    pairs = {frozenset(model.geom(g).name for g in pair) for pair in touching_pairs(model, data, geoms, False)}
    assert ({"base", "disc"} in pairs) != is_left_out
    assert {"arm", "pole"} in pairs and {"base", "arm"} in pairs
    contacts = mujoco.MjData(model)
    mujoco.mj_forward(model, contacts)
    assert any(
        {model.geom(int(c.geom1)).name, model.geom(int(c.geom2)).name} == {"base", "disc"} and c.dist <= 0.0
        for c in contacts.contact
    ) == (gap < 0.0)
