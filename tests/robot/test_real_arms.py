"""Real arms of robosuite's wheel: as many free configurations as C MuJoCo finds, and none free that touches."""

import re
import subprocess
import sys
import zipfile
from pathlib import Path

import jax
import mujoco
import numpy as np
import pytest

from vsearch_jax.config import PlanningConfig, SceneConfig
from vsearch_jax.planning import edge_is_free, start_limits
from vsearch_jax.robot import build_arm, forward_kinematics, is_free
from vsearch_jax.robot.blocking import describe_blocking_contacts
from vsearch_jax.scene import Scene, build_scene

pytestmark = pytest.mark.slow

ARMS = ["panda", "sawyer", "iiwa", "xarm7", "ur5e", "jaco", "kinova3", "baxter"]
NUM_CONFIGURATIONS, NUM_EDGES = 400, 48


@pytest.fixture(scope="module")
def robots(tmp_path_factory) -> Path:
    """The folder of robosuite's robots, from its wheel on the package index."""
    folder = tmp_path_factory.mktemp("robosuite")
    command = [sys.executable, "-m", "pip", "download", "--no-deps", "--quiet", "robosuite==1.5.2", "-d", str(folder)]
    if subprocess.run(command, check=False).returncode != 0:
        pytest.skip("the package index does not serve robosuite 1.5.2")
    with zipfile.ZipFile(next(folder.glob("*.whl"))) as wheel:
        wheel.extractall(folder)
    return folder / "robosuite" / "models" / "assets" / "robots"


def _write_arm(robots: Path, name: str, excludes: list[tuple[str, str]]) -> Path:
    """Writes the robot with a tool centre point, a wrist camera, and pairs of bodies that may touch."""
    spec = mujoco.MjSpec.from_file(str(robots / name / "robot.xml"))
    hand = spec.body("right_hand")
    hand.add_site(name="tcp", pos=[0.0, 0.0, 0.1])
    hand.add_camera(name="wrist", pos=[0.05, 0.0, 0.05], quat=[0.0, 1.0, 0.0, 0.0])
    for joint in spec.joints:
        if not any(joint.range):  # Continuous joints; planning needs limits.
            joint.range, joint.limited = [-3.14, 3.14], True
    for first, second in excludes:
        spec.add_exclude(bodyname1=first, bodyname2=second)
    spec.compile()
    path = robots / name / "with_camera.xml"
    path.write_text(spec.to_xml())
    return path


def _scene_without_blocking_contacts(robots: Path, name: str) -> Scene:
    """Builds the scene as a user does: with the <exclude> lines that the message names."""
    excludes: list[tuple[str, str]] = []
    for _ in range(4):
        path = _write_arm(robots, name, excludes)
        scene = build_scene(SceneConfig(arm=str(path), mount_height=3.0, table_clearance=0.0))
        new = re.findall(r'body1="(\w+)" body2="(\w+)"', describe_blocking_contacts(scene))
        if not new:
            return scene
        excludes += new
    raise AssertionError(f"{name} has contacts in all configurations after {excludes}")


def _is_free_in_mujoco(scene: Scene, qpos: np.ndarray) -> np.ndarray:
    data, result = mujoco.MjData(scene.mj_model), []
    for values in qpos:
        data.qpos[:] = values
        mujoco.mj_fwdPosition(scene.mj_model, data)
        result.append(data.ncon == 0)
    return np.array(result)


@pytest.mark.parametrize("name", ARMS)
def test_the_share_of_free_configurations_is_that_of_mujoco(robots, name):
    scene = _scene_without_blocking_contacts(robots, name)
    arm = build_arm(scene)
    lower, upper = start_limits(arm)
    qpos = np.random.default_rng(0).uniform(lower, upper, (NUM_CONFIGURATIONS, len(lower))).astype(np.float32)
    check = jax.jit(lambda arm, qpos: jax.vmap(lambda q: is_free(arm, forward_kinematics(arm, q)))(qpos))
    ours, theirs = np.asarray(check(arm, qpos)), _is_free_in_mujoco(scene, qpos)
    print(f"{name}: free {100 * ours.mean():.1f} %, C MuJoCo {100 * theirs.mean():.1f} %")
    assert theirs.mean() > 0.3
    assert not np.any(ours & ~theirs)
    assert abs(ours.mean() - theirs.mean()) <= 0.02


@pytest.mark.parametrize("name", ["panda", "sawyer"])
def test_edges_that_are_proven_free_are_free_in_mujoco(robots, name):
    scene = _scene_without_blocking_contacts(robots, name)
    arm, random = build_arm(scene), np.random.default_rng(1)
    lower, upper = (np.asarray(limit) for limit in start_limits(arm))
    starts = random.uniform(lower, upper, (NUM_EDGES, len(lower))).astype(np.float32)
    goals = np.clip(starts + random.normal(size=starts.shape) * 0.5, lower, upper).astype(np.float32)
    check = jax.jit(lambda arm, a, b: jax.vmap(lambda a, b: edge_is_free(arm, a, b, PlanningConfig()))(a, b))
    is_proven = np.asarray(check(arm, starts, goals))
    assert is_proven.mean() > 0.2
    places = np.linspace(0.0, 1.0, 60)[:, None]
    for start, goal in zip(starts[is_proven], goals[is_proven], strict=True):
        assert np.all(_is_free_in_mujoco(scene, start + places * (goal - start)))
