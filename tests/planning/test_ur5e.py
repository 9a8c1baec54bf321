"""The UR5e: its kinematics equal the manufacturer's Denavit-Hartenberg table, and it is loaded by name."""

import mujoco
import numpy as np
import pytest

from vsearch_jax.config import SceneConfig
from vsearch_jax.scene import build_scene, xml_folder

# Universal Robots, "DH Parameters for calculations of kinematics and dynamics": a and d in m, alpha in rad.
A = [0.0, -0.425, -0.3922, 0.0, 0.0, 0.0]
D = [0.1625, 0.0, 0.0, 0.1333, 0.0997, 0.0996]
ALPHA = [np.pi / 2, 0.0, 0.0, np.pi / 2, -np.pi / 2, 0.0]
# m, from the flange to the tool centre point.
TOOL = 0.24


def _flange_pose(theta: np.ndarray) -> np.ndarray:
    """Pose f64[4, 4] of the flange for Denavit-Hartenberg angles f64[6] rad."""
    pose = np.eye(4)
    for t, a, d, alpha in zip(theta, A, D, ALPHA, strict=True):
        ct, st, ca, sa = np.cos(t), np.sin(t), np.cos(alpha), np.sin(alpha)
        pose = pose @ [[ct, -st * ca, st * sa, a * ct], [st, ct * ca, -ct * sa, a * st], [0, sa, ca, d], [0, 0, 0, 1]]
    return pose


def test_kinematics_equal_the_denavit_hartenberg_table():
    model = mujoco.MjModel.from_xml_path(str(xml_folder() / "arm" / "ur5e.xml"))
    data, random = mujoco.MjData(model), np.random.default_rng(0)
    # At zero the MJCF's arm is upright and faces +y; the table's arm lies along -x.
    shift = np.array([0.0, np.pi / 2, 0.0, np.pi / 2, 0.0, 0.0])
    base_angle = None
    for _ in range(16):
        joints = random.uniform(-2, 2, 6)
        data.qpos[:] = joints
        mujoco.mj_kinematics(model, data)
        theirs = _flange_pose(joints - shift)
        tip = theirs[:3, 3] + TOOL * theirs[:3, 2]
        ours = data.site("tcp").xpos
        angle = np.arctan2(tip[1], tip[0]) - np.arctan2(ours[1], ours[0])
        base_angle = angle if base_angle is None else base_angle
        assert np.linalg.norm(tip[:2]) == pytest.approx(np.linalg.norm(ours[:2]), abs=1e-6)
        assert tip[2] == pytest.approx(ours[2], abs=1e-6)
        assert np.cos(angle - base_angle) == pytest.approx(1.0, abs=1e-6)


def test_the_scene_has_its_six_joints_and_their_speed_limits():
    scene = build_scene(SceneConfig(arm="ur5e"))
    assert len(scene.joint_ids) == scene.mj_model.nq == 6
    np.testing.assert_allclose(scene.mj_model.jnt_user[:, 0], np.pi, rtol=1e-4)
