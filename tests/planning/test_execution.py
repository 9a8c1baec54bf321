"""Dynamic motions end where they are planned, within the data sheet's torques, and equal those of C MuJoCo."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from oracles.planning import ContactOracle
from vsearch_jax.config import IKConfig, PlanningConfig, SceneConfig
from vsearch_jax.geometry import rotation_error, view_pose
from vsearch_jax.planning import execute, ik, rrt_connect, state_at, time_path
from vsearch_jax.robot.arm import build_arm, camera_pose, forward_kinematics
from vsearch_jax.scene import build_scene
from vsearch_jax.types import View

CONFIG = PlanningConfig()
# N m, largest torques of the LWR's joints by its data sheet.
TORQUES = np.array([176, 176, 100, 100, 100, 38, 38])


def _execute_moves(count: int):
    """Executions of moves between random views of the band, with their planned paths and errors at the end."""
    scene = build_scene(SceneConfig())
    arm = build_arm(scene)
    random = np.random.default_rng(4)
    azimuth = jnp.asarray(random.uniform(-np.pi, np.pi, 4 * count), jnp.float32)
    elevation = jnp.asarray(np.deg2rad(random.uniform(41, 69, 4 * count)), jnp.float32)
    center, radius = jnp.asarray(scene.center, jnp.float32), jnp.float32(scene.radius)

    def solve(a, e):
        return ik(arm, view_pose(View(a, e), center, radius), arm.home, IKConfig())

    result = jax.jit(jax.vmap(solve))(azimuth, elevation)
    qpos = np.asarray(result.qpos)[np.asarray(result.is_converged)]
    starts, goals = qpos[:count], qpos[count : 2 * count]
    assert len(goals) == count
    keys = jax.random.split(jax.random.key(0), count)
    paths = jax.jit(jax.vmap(lambda k, a, b: rrt_connect(arm, k, a, b, CONFIG)))(keys, starts, goals)
    found = np.asarray(paths.status) == 0
    paths = jax.tree.map(lambda leaf: leaf[found], paths)

    def execute_path(path):
        trajectory = time_path(arm, path, CONFIG)
        done = execute(arm, scene.mjx_model, trajectory, CONFIG)
        reached, wanted = (camera_pose(arm, forward_kinematics(arm, q)) for q in (done.qpos, path.waypoints[-1]))
        position = jnp.linalg.norm(reached.translation() - wanted.translation())
        angle = rotation_error(reached.rotation().as_matrix(), wanted.rotation().as_matrix())
        return trajectory, done, position, angle

    return scene, arm, paths, *jax.jit(jax.vmap(execute_path))(paths), found


def _check(moves, share: float) -> None:
    _, _, paths, _, done, position, angle, found = moves
    assert found.mean() >= 0.98
    has_arrived = (np.asarray(position) < 1e-3) & (np.asarray(angle) < np.deg2rad(0.2))
    assert has_arrived.mean() >= share
    assert np.all(np.asarray(done.peak_torque)[:, :7] <= TORQUES + 1e-3)
    assert np.all(np.asarray(done.energy) > 0.0) and np.all(np.asarray(done.energy) < 1000.0)
    np.testing.assert_allclose(done.qpos, np.asarray(paths.waypoints)[:, -1], atol=0.02)


@pytest.fixture(scope="module")
def moves():
    return _execute_moves(4)


def test_the_arm_ends_at_the_planned_view(moves):
    _check(moves, 1.0)


def test_c_mujoco_makes_the_same_motion_without_contact(moves):
    scene, arm, paths, trajectories, done, _, _, _ = moves
    model, oracle = scene.mj_model, ContactOracle(scene)
    states_at = jax.jit(jax.vmap(lambda trajectory, t: state_at(arm, trajectory, t), in_axes=(None, 0)))
    trajectory = jax.tree.map(lambda leaf: leaf[0], trajectories)
    count = round(float(done.time[0]) / model.opt.timestep)
    joints, velocity = (
        np.asarray(x)
        for x in states_at(trajectory, np.arange(count, dtype=np.float32) * np.float32(model.opt.timestep))
    )
    lead = -model.actuator_biasprm[:, 2] / model.actuator_gainprm[:, 0]
    data = mujoco.MjData(model)
    data.qpos[:] = paths.waypoints[0, 0]
    for step in range(count):
        data.ctrl[:] = joints[step] + lead * velocity[step]
        mujoco.mj_step(model, data)
        assert data.ncon == 0
        if step % 10 == 0:
            assert oracle.is_free(data.qpos)
    np.testing.assert_allclose(done.qpos[0], data.qpos, atol=1e-3)


@pytest.mark.slow
def test_five_hundred_moves_end_at_their_views():
    _check(_execute_moves(500), 0.99)
