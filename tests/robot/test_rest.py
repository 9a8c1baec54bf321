"""Grippers with equality constraints rest where C MuJoCo finds the constraints satisfied."""

import mujoco
import numpy as np
import pytest

from vsearch_jax.robot.rest import rest_pose

FINGERS = """
<mujoco>
  <worldbody>
    <body>
      <joint name="wrist" axis="0 0 1" range="-1 2"/>
      <geom size="0.02"/>
      <body pos="0.1 0 0">
        <joint name="driver" type="slide" axis="0 1 0" range="0 0.04"/>
        <geom size="0.01"/>
      </body>
      <body pos="0.1 0 0">
        <joint name="mimic" type="slide" axis="0 -1 0" range="0 0.1"/>
        <geom size="0.01"/>
      </body>
    </body>
  </worldbody>
  <equality><joint joint1="mimic" joint2="driver" polycoef="{offset} {ratio} 0 0 0"/></equality>
</mujoco>
"""
# A four-bar linkage: crank and rocker turn on the base, the coupler closes the loop. In the middle of the limits the
# ends are centimetres apart.
LINKAGE = """
<mujoco>
  <worldbody>
    <body>
      <joint name="wrist" axis="0 0 1" range="-1 2"/>
      <geom size="0.02"/>
      <body name="crank" pos="0.1 0 0">
        <joint name="crank" axis="0 1 0" range="0 60"/>
        <geom type="capsule" size="0.005" fromto="0 0 0 0 0 0.05"/>
        <body name="coupler" pos="0 0 0.05">
          <joint name="coupler" axis="0 1 0" range="-90 20"/>
          <geom type="capsule" size="0.005" fromto="0 0 0 0.06 0 0"/>
        </body>
      </body>
      <body name="rocker" pos="0.16 0 0">
        <joint name="rocker" axis="0 1 0" range="{low} {high}"/>
        <geom type="capsule" size="0.005" fromto="0 0 0 0 0 0.05"/>
      </body>
    </body>
  </worldbody>
  <equality><connect body1="coupler" body2="rocker" anchor="0.06 0 0"/></equality>
</mujoco>
"""


def _rest(text: str) -> tuple[mujoco.MjModel, np.ndarray]:
    model = mujoco.MjModel.from_xml_string(text)
    return model, rest_pose(model, model.jnt_range[:, 0], model.jnt_range[:, 1], (0,))


@pytest.mark.parametrize(
    "text",
    [
        FINGERS.format(offset=0, ratio=1),
        FINGERS.format(offset=0.01, ratio=1.5),
        LINKAGE.format(low=0, high=90),
        LINKAGE.format(low=10, high=90),
    ],
    ids=["mimic", "mimic with an offset", "linkage", "linkage whose qpos0 is outside the limits"],
)
def test_the_rest_pose_keeps_equality_constraints(text):
    model, qpos = _rest(text)
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_fwdPosition(model, data)
    violation = data.efc_pos[data.efc_type == mujoco.mjtConstraint.mjCNSTR_EQUALITY]
    assert len(violation) > 0 and np.abs(violation).max() < 2e-4
    assert np.all((qpos >= model.jnt_range[:, 0]) & (qpos <= model.jnt_range[:, 1]))
    assert qpos[0] == pytest.approx(0.5 * model.jnt_range[0].sum())


def test_joints_whose_constraints_hold_rest_in_the_middle_of_their_limits():
    model, qpos = _rest(FINGERS.format(offset=0, ratio=2.5))
    np.testing.assert_allclose(qpos, model.jnt_range.mean(axis=1), atol=1e-9)
