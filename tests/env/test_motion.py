"""How the environment moves: by joints set, along a planned path, or by the arm's dynamics."""

import dataclasses
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vsearch_jax as vs
from vsearch_jax.config import ConfigError, EnvConfig
from vsearch_jax.geometry import view_pose
from vsearch_jax.planning import duration, straight_duration, time_path
from vsearch_jax.scene import SceneError, xml_folder
from vsearch_jax.types import Path, PlanStatus, View

CONFIG = vs.Config.preset("smoke")


@pytest.fixture(scope="module")
def by_joints() -> vs.ViewSearchEnv:
    return vs.ViewSearchEnv(CONFIG)


def _moving(env: vs.ViewSearchEnv, **changes) -> vs.ViewSearchEnv:
    config = dataclasses.replace(CONFIG, env=dataclasses.replace(CONFIG.env, **changes))
    return vs.ViewSearchEnv(config, env.encoder, env.reach)


def _views(env: vs.ViewSearchEnv, count: int):
    """Views around the object, and the joints of the middle of the map."""
    views = View(jnp.linspace(-3.0, 3.0, count), jnp.full(count, jnp.mean(env.reach.band)))
    return views, env.reach.qpos[0, int(np.argmax(np.asarray(env.reach.is_reachable[0])))]


@pytest.fixture(scope="module")
def by_path(by_joints):
    """Observations and motions of eight views, along paths."""
    env = _moving(by_joints, reachable="path")
    views, start = _views(env, 8)
    return jax.jit(jax.vmap(lambda view: env.move_to_view(view, start)))(views)


@pytest.fixture(scope="module")
def solved(by_joints):
    """Joints of the same views by inverse kinematics, and whether they are reachable."""
    views, start = _views(by_joints, 8)
    return jax.jit(jax.vmap(lambda view: by_joints.solve(view, start)))(views)


def _errors(env: vs.ViewSearchEnv, views: View, observations) -> tuple[np.ndarray, np.ndarray]:
    wanted = jax.vmap(lambda view: view_pose(view, env.center, env.scene.radius))(views)
    position = np.linalg.norm(wanted.translation() - observations.camera.position, axis=-1)
    cosine = np.einsum("nij,nij->n", wanted.rotation().as_matrix(), observations.camera.rotation)
    return position, np.arccos(np.clip((cosine - 1) / 2, -1, 1))


def test_a_path_leads_where_kinematics_alone_does(by_path, solved):
    (qpos, first), second = solved, np.asarray(by_path[1].is_found)
    assert not np.any(second & ~np.asarray(first))
    assert second.sum() >= 7
    np.testing.assert_allclose(by_path[0].qpos[second], qpos[second], atol=1e-5)


@pytest.mark.slow
def test_dynamics_end_near_the_view(by_joints):
    env = _moving(by_joints, reachable="path", motion="dynamic")
    views, start = _views(env, 4)
    observations, motions = jax.jit(jax.vmap(lambda view: env.move_to_view(view, start)))(views)
    is_reachable = np.asarray(motions.is_found)
    position, turn = _errors(env, views, observations)
    # The error of IK, 1 mm and 0.1 degrees, and that of the motion.
    assert np.all(position[is_reachable] < 2e-3) and np.all(turn[is_reachable] < np.deg2rad(0.3))


def test_a_motion_costs_what_its_timing_says(by_joints, by_path, solved):
    (_, motions), (qpos, _) = by_path, solved
    _, start = _views(by_joints, 8)
    straight = jax.vmap(lambda goal: by_joints.straight(start, goal))(qpos)
    found = np.asarray(motions.is_found)
    np.testing.assert_allclose(
        straight.travel, np.linalg.norm(np.asarray(qpos - start[None])[:, :7], axis=1), rtol=1e-5
    )
    # A way round something is longer than the straight one.
    assert np.all(motions.travel[found] >= straight.travel[found] * 0.999)
    assert np.all(motions.duration[found] >= straight.duration[found] * 0.97)
    assert np.all(motions.travel[~found] == 0.0) and np.all(motions.duration[~found] == 0.0)


@pytest.mark.parametrize("share", [1.0, 0.1, 0.01])
def test_straight_motions_last_as_long_as_timed_ones(by_joints, share):
    arm, config = by_joints.arm, CONFIG.planning
    goal = arm.home.at[jnp.arange(7)].add(share * jnp.array([0.9, -0.3, 0.4, 0.2, -0.8, 0.1, 0.5]))
    waypoints = jnp.concatenate([arm.home[None], jnp.repeat(goal[None], config.max_waypoints - 1, axis=0)])
    path = Path(waypoints, jnp.float32(0.0), jnp.int32(PlanStatus.FOUND))
    timed = duration(jax.jit(lambda path: time_path(arm, path, config))(path))
    assert float(straight_duration(arm, arm.home, goal, config)) == pytest.approx(float(timed), rel=0.03)


def test_dynamics_without_actuators_are_refused(tmp_path):
    path = tmp_path / "arm.xml"
    text = (xml_folder() / "arm" / "lwr.xml").read_text()
    path.write_text(re.sub(r'<position [^>]*joint="A3"[^>]*/>', "", text))
    scene = dataclasses.replace(CONFIG.scene, arm=str(path))
    motion = dataclasses.replace(CONFIG.env, reachable="path", motion="dynamic")
    with pytest.raises(SceneError, match=r"joint arm/A3 has no position actuator"):
        vs.ViewSearchEnv(dataclasses.replace(CONFIG, scene=scene, env=motion))


def test_dynamics_without_a_path_are_refused():
    with pytest.raises(ConfigError, match=r"kinematic where env\.reachable is 'ik'"):
        EnvConfig(motion="dynamic")
