"""The second arm: its kinematics are the maker's Denavit-Hartenberg table, and it works by its name alone."""

import mujoco
import numpy as np
import pytest

from vsearch_jax.config import SceneConfig
from vsearch_jax.scene import build_scene, xml_folder

# Universal Robots, "DH Parameters for calculations of kinematics and dynamics": a and d in m, alpha in rad.
A = [0.0, -0.425, -0.3922, 0.0, 0.0, 0.0]
D = [0.1625, 0.0, 0.0, 0.1333, 0.0997, 0.0996]
ALPHA = [np.pi / 2, 0.0, 0.0, np.pi / 2, -np.pi / 2, 0.0]
TOOL = 0.24


def _flange(theta: np.ndarray) -> np.ndarray:
    pose = np.eye(4)
    for t, a, d, alpha in zip(theta, A, D, ALPHA, strict=True):
        ct, st, ca, sa = np.cos(t), np.sin(t), np.cos(alpha), np.sin(alpha)
        pose = pose @ [[ct, -st * ca, st * sa, a * ct], [st, ct * ca, -ct * sa, a * st], [0, sa, ca, d], [0, 0, 0, 1]]
    return pose


def test_kinematics_are_those_of_the_table():
    model = mujoco.MjModel.from_xml_path(str(xml_folder() / "arm" / "ur5e.xml"))
    data, random = mujoco.MjData(model), np.random.default_rng(0)
    # The MJCF stands upright at zero and faces +y; the table lies flat along -x.
    shift = np.array([0.0, np.pi / 2, 0.0, np.pi / 2, 0.0, 0.0])
    base = None
    for _ in range(16):
        joints = random.uniform(-2, 2, 6)
        data.qpos[:] = joints
        mujoco.mj_kinematics(model, data)
        theirs = _flange(joints - shift)
        tip = theirs[:3, 3] + TOOL * theirs[:3, 2]
        ours = data.site("tcp").xpos
        turn = np.arctan2(tip[1], tip[0]) - np.arctan2(ours[1], ours[0])
        base = turn if base is None else base
        assert np.linalg.norm(tip[:2]) == pytest.approx(np.linalg.norm(ours[:2]), abs=1e-6)
        assert tip[2] == pytest.approx(ours[2], abs=1e-6)
        assert np.cos(turn - base) == pytest.approx(1.0, abs=1e-6)


def test_it_has_six_axes_under_the_mount():
    scene = build_scene(SceneConfig(arm="ur5e"))
    assert len(scene.joint_ids) == scene.mj_model.nq == 6
    np.testing.assert_allclose(scene.mj_model.jnt_user[:, 0], np.pi, rtol=1e-4)
