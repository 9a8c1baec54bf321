"""Motion of the arm in the environment: joint values set directly, a planned path, or the arm's dynamics."""

import dataclasses
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vsearch_jax as vs
from vsearch_jax.config import ConfigError, EnvConfig
from vsearch_jax.env import motion as motions
from vsearch_jax.geometry import view_pose
from vsearch_jax.planning import duration, straight_duration, time_path
from vsearch_jax.scene import SceneError, xml_folder
from vsearch_jax.types import Path, PlanStatus, View

CONFIG = vs.Config.preset("smoke")


@pytest.fixture(scope="module")
def env() -> vs.ViewSearchEnv:
    """Environment that sets joint values directly."""
    return vs.ViewSearchEnv(CONFIG)


def _with_motion(env: vs.ViewSearchEnv, **changes) -> vs.ViewSearchEnv:
    """Returns an environment with changed fields of EnvConfig."""
    config = dataclasses.replace(CONFIG, env=dataclasses.replace(CONFIG.env, **changes))
    return vs.ViewSearchEnv(config, env.encoder, env.reach)


def _views(env: vs.ViewSearchEnv, count: int):
    """Returns views around the object, and the joint values of a reachable cell of the map."""
    views = View(jnp.linspace(-3.0, 3.0, count), jnp.full(count, jnp.mean(env.reach.band)))
    return views, env.reach.qpos[0, int(np.argmax(np.asarray(env.reach.is_reachable[0])))]


@pytest.fixture(scope="module")
def path_results(env):
    """Observations and motions for eight views, with planned paths."""
    env = _with_motion(env, reachable="path")
    views, start = _views(env, 8)
    return jax.jit(jax.vmap(lambda view: env.move_to_view(view, start)))(views)


@pytest.fixture(scope="module")
def ik_results(env):
    """Joint values for the same views by inverse kinematics, and whether the views are reachable."""
    views, start = _views(env, 8)
    return jax.jit(jax.vmap(lambda view: env.solve_joints(view, start)))(views)


def _errors(env: vs.ViewSearchEnv, views: View, observations) -> tuple[np.ndarray, np.ndarray]:
    """Returns position errors in m and rotation errors in rad of the observations' cameras."""
    commanded = jax.vmap(lambda view: view_pose(view, env.center, env.scene.radius))(views)
    position = np.linalg.norm(commanded.translation() - observations.camera.position, axis=-1)
    cosine = np.einsum("nij,nij->n", commanded.rotation().as_matrix(), observations.camera.rotation)
    return position, np.arccos(np.clip((cosine - 1) / 2, -1, 1))


@pytest.mark.slow
def test_path_ends_at_the_solution_of_inverse_kinematics(path_results, ik_results):
    (qpos, is_solved), has_path = ik_results, np.asarray(path_results[1].is_found)
    assert not np.any(has_path & ~np.asarray(is_solved))
    assert has_path.sum() >= 7
    np.testing.assert_allclose(path_results[0].qpos[has_path], qpos[has_path], atol=1e-5)


def test_the_next_goal_is_tried_where_no_path_leads_to_one(env):
    reached = env.reach.qpos[np.asarray(env.reach.is_reachable)]
    start, free, other = reached[0], reached[len(reached) // 2], reached[-1]
    outside = free.at[1].set(9.0)
    goals = jnp.stack([outside, other, free])
    assert CONFIG.planning.num_goals == 3

    @jax.jit
    @jax.vmap
    def move(is_goal):
        return motions.move_joints(env.scene, env.arm, start, lambda i: (goals[i], is_goal[i]), CONFIG)

    ends, found = move(
        jnp.asarray([[True, False, True], [True, False, False], [False, True, True], [True, True, True]])
    )
    np.testing.assert_array_equal(found.is_found, [True, False, False, True])
    np.testing.assert_allclose(ends, jnp.stack([free, start, start, other]), atol=1e-5)
    assert (np.asarray(found.travel)[[0, 3]] > 0.01).all()


@pytest.mark.slow
def test_dynamic_motion_ends_near_the_view(env):
    env = _with_motion(env, reachable="path", motion="dynamic")
    views, start = _views(env, 4)
    observations, motions = jax.jit(jax.vmap(lambda view: env.move_to_view(view, start)))(views)
    is_reachable = np.asarray(motions.is_found)
    position, rotation = _errors(env, views, observations)
    # IK contributes up to 1 mm and 0.1 degrees, the motion the rest.
    assert np.all(position[is_reachable] < 2e-3) and np.all(rotation[is_reachable] < np.deg2rad(0.3))


@pytest.mark.slow
def test_planned_motion_costs_at_least_the_straight_motion(env, path_results, ik_results):
    (_, motions), (qpos, _) = path_results, ik_results
    _, start = _views(env, 8)
    straight = jax.vmap(lambda goal: env.straight_motion(start, goal))(qpos)
    found = np.asarray(motions.is_found)
    np.testing.assert_allclose(
        straight.travel, np.linalg.norm(np.asarray(qpos - start[None])[:, :7], axis=1), rtol=1e-5
    )
    # A path around an obstacle is longer than the straight path.
    assert np.all(motions.travel[found] >= straight.travel[found] * 0.999)
    assert np.all(motions.duration[found] >= straight.duration[found] * 0.97)
    assert np.all(motions.travel[~found] == 0.0) and np.all(motions.duration[~found] == 0.0)


@pytest.mark.parametrize("share", [1.0, 0.1, 0.01])
def test_duration_of_a_straight_motion_equals_its_timed_trajectory(env, share):
    arm, config = env.arm, CONFIG.planning
    goal = arm.home.at[jnp.arange(7)].add(share * jnp.array([0.9, -0.3, 0.4, 0.2, -0.8, 0.1, 0.5]))
    waypoints = jnp.concatenate([arm.home[None], jnp.repeat(goal[None], config.max_waypoints - 1, axis=0)])
    path = Path(waypoints, jnp.float32(0.0), jnp.int32(PlanStatus.FOUND))
    timed = duration(jax.jit(lambda path: time_path(arm, path, config))(path))
    assert float(straight_duration(arm, arm.home, goal, config)) == pytest.approx(float(timed), rel=0.03)


def test_dynamic_motion_without_an_actuator_raises_an_error_naming_the_joint(tmp_path):
    path = tmp_path / "arm.xml"
    text = (xml_folder() / "arm" / "lwr.xml").read_text()
    path.write_text(re.sub(r'<position [^>]*joint="A3"[^>]*/>', "", text))
    scene = dataclasses.replace(CONFIG.scene, arm=str(path))
    motion = dataclasses.replace(CONFIG.env, reachable="path", motion="dynamic")
    with pytest.raises(SceneError, match=r"joint arm/A3 has no position actuator"):
        vs.ViewSearchEnv(dataclasses.replace(CONFIG, scene=scene, env=motion))


def test_dynamic_motion_without_path_planning_raises_an_error():
    with pytest.raises(ConfigError, match=r"kinematic where env\.reachable is 'ik'"):
        EnvConfig(motion="dynamic")
