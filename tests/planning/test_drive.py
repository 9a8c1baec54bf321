"""Actuators of every kind follow a motion or hold still: C MuJoCo computes no force at the commanded controls."""

import types

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mujoco import mjx

from vsearch_jax.planning.drive import actuator_controls, check_drive, start_data
from vsearch_jax.scene import SceneError

# The gripper's actuators come first: the tendon's number equals that of the joint `shoulder`.
ARM = """
<mujoco>
  <worldbody>
    <body name="upper">
      <joint name="shoulder" axis="0 0 1" range="-2 2" limited="true" damping="1"/>
      <geom type="capsule" size="0.03" fromto="0 0 0 0.3 0 0"/>
      <body name="lower" pos="0.3 0 0">
        <joint name="elbow" axis="0 1 0" range="-2 2" limited="true" damping="1"/>
        <geom type="capsule" size="0.03" fromto="0 0 0 0.3 0 0"/>
        <site name="flange" pos="0.3 0 0"/>
        <body name="left" pos="0.3 0.02 0">
          <joint name="left" type="slide" axis="0 1 0" range="0 0.04" limited="true"/>
          <geom type="box" size="0.02 0.005 0.01"/>
          <site name="left_tip"/>
        </body>
        <body name="right" pos="0.3 -0.02 0">
          <joint name="right" type="slide" axis="0 -1 0" range="0 0.04" limited="true"/>
          <geom type="box" size="0.02 0.005 0.01"/>
          <site name="right_tip"/>
        </body>
      </body>
    </body>
  </worldbody>
  <tendon>
    <fixed name="fingers"><joint joint="left" coef="0.5"/><joint joint="right" coef="0.5"/></fixed>
    <spatial name="string"><site site="left_tip"/><site site="right_tip"/></spatial>
  </tendon>
  <actuator>
    <general name="grip" tendon="fingers" gainprm="100" biasprm="0 -100 -10" biastype="affine"/>
    <position name="string" tendon="string" kp="50" gear="3"/>
    <position name="slow_finger" joint="left" kp="20" timeconst="0.1"/>
    <intvelocity name="integrated_finger" joint="right" kp="30" actrange="-1 1"/>
    <position name="elbow" joint="elbow" kp="200" kv="20" gear="2"/>
    <general name="shoulder" joint="shoulder" gainprm="300" biasprm="5 -300 -30" biastype="affine" gear="-1.5"/>
    <velocity name="shoulder_speed" joint="shoulder" kv="4"/>
    <motor name="elbow_motor" joint="elbow" gear="7"/>
    {extra}
  </actuator>
</mujoco>
"""


def _parts(extra: str = ""):
    """Returns the model, and what `check_drive` reads of its scene and its arm."""
    model = mujoco.MjModel.from_xml_string(ARM.format(extra=extra))
    return (
        model,
        types.SimpleNamespace(mj_model=model, joint_ids=(0, 1)),
        types.SimpleNamespace(joints_without_speed=(), speed=jnp.ones(model.nq)),
    )


def test_no_actuator_exerts_a_force_on_the_planned_motion():
    model, scene, arm = _parts()
    check_drive(scene, arm)
    mjx_model = mjx.put_model(model)
    start = np.array([0.4, -0.7, 0.01, 0.03], np.float32)
    template = types.SimpleNamespace(data=mjx.make_data(mjx_model))
    first, held = jax.jit(lambda qpos: start_data(template, mjx_model, qpos))(start)
    controls = jax.jit(lambda qpos, velocity: actuator_controls(mjx_model, qpos, velocity, held))
    random = np.random.default_rng(0)
    for _ in range(8):
        qpos, velocity = start.copy(), np.zeros(4, np.float32)
        qpos[:2], velocity[:2] = random.uniform(-2, 2, 2), random.uniform(-3, 3, 2)
        data = mujoco.MjData(model)
        data.qpos[:], data.qvel[:], data.act[:] = qpos, velocity, first.act
        data.ctrl[:] = controls(qpos, velocity)
        mujoco.mj_forward(model, data)
        np.testing.assert_allclose(data.actuator_force, 0.0, atol=2e-3)
        mujoco.mj_step(model, data)
        np.testing.assert_allclose(data.act, first.act, atol=1e-4)


@pytest.mark.parametrize(
    ("extra", "reason"),
    [
        ('<position name="bad" joint="elbow" kp="10" timeconst="0.1"/>', "activation"),
        ('<intvelocity name="bad" joint="elbow" kp="10" actrange="-1 1"/>', "activation"),
        ('<muscle name="bad" joint="elbow"/>', "not linear"),
        ('<position name="bad" site="left_tip" refsite="flange" kp="10" gear="1 0 0 0 0 0"/>', None),
        (
            '<general name="bad" site="left_tip" gainprm="1" biasprm="3 0 0" biastype="affine" gear="0 0 1 0 0 0"/>',
            "site",
        ),
    ],
)
def test_actuators_that_cannot_follow_are_refused_by_name(extra, reason):
    _, scene, arm = _parts(extra)
    if reason is None:  # Between two sites of the gripper and the last link: it does not act on the arm's joints.
        check_drive(scene, arm)
        return
    with pytest.raises(SceneError, match=rf"'bad'.*{reason}"):
        check_drive(scene, arm)


def test_a_joint_without_a_position_actuator_is_named():
    _, _, arm = _parts()
    spec = mujoco.MjSpec.from_string(ARM.format(extra=""))
    spec.delete(spec.actuator("elbow"))
    with pytest.raises(SceneError, match="joint elbow has no position actuator"):
        check_drive(types.SimpleNamespace(mj_model=spec.compile(), joint_ids=(0, 1)), arm)
