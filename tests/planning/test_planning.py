"""Paths by RRT and their timing, compared with C MuJoCo and with the limits of the arm."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from samples.planning_problems import CONFIG, PlanningProblems
from samples.second_arm import MJCF
from vsearch_jax.config import SceneConfig
from vsearch_jax.planning import PlanningError, rrt, start_limits, state_at, time_path
from vsearch_jax.robot.arm import build_arm
from vsearch_jax.scene import SceneError, build_scene
from vsearch_jax.types import Path, PlanStatus


@pytest.fixture(scope="module")
def problems() -> PlanningProblems:
    return PlanningProblems(64, 0)


def _check_paths(problems: PlanningProblems) -> None:
    waypoints = np.asarray(problems.paths.waypoints)
    for index in np.flatnonzero(problems.found):
        path = waypoints[index]
        np.testing.assert_allclose(path[0], problems.start[index], atol=1e-6)
        np.testing.assert_allclose(path[-1], problems.goal[index], atol=1e-4)
        assert problems.oracle.count_blocked(path) == 0, index
        length = np.linalg.norm(np.diff(path, axis=0), axis=1).sum()
        assert float(problems.paths.length[index]) == pytest.approx(length, rel=1e-4)


def test_paths_are_free_and_join_start_and_goal(problems):
    assert problems.found.mean() >= 0.95
    assert (np.asarray(problems.paths.length) > 1.05 * np.linalg.norm(problems.goal - problems.start, axis=1)).any()
    _check_paths(problems)


@pytest.mark.slow
def test_a_single_tree_finds_free_paths_and_reports_exhausted_budgets(problems):
    config = dataclasses.replace(CONFIG, max_iterations=64)
    paths = jax.jit(jax.vmap(lambda k, a, b: rrt(problems.arm, k, a, b, config)))(
        problems.keys, problems.start, problems.goal
    )
    found = np.asarray(paths.status) == PlanStatus.FOUND
    assert found.mean() >= 0.6
    assert np.all(np.asarray(paths.status)[~found] == PlanStatus.EXHAUSTED) and not np.all(found)
    assert np.all(np.isinf(np.asarray(paths.length)[~found]))
    assert sum(problems.oracle.count_blocked(path) for path in np.asarray(paths.waypoints)[found]) == 0


def test_bad_starts_and_goals_have_a_status(problems):
    start, goal = problems.start[0], problems.goal[0]
    random = np.random.default_rng(0).uniform(*start_limits(problems.arm), (200, 9)).astype(np.float32)
    folded = next(qpos for qpos in random if problems.oracle.compute_contacts(qpos).ncon > 0)
    outside = goal.copy()
    outside[1] = 2.5
    nan = np.where(np.arange(9) == 3, np.nan, start).astype(np.float32)
    cases = [(folded, goal), (start, folded), (start, outside), (nan, goal), (start, nan), (outside, goal)]
    # The number of problems is the same as in the other tests, so nothing is compiled again.
    starts, goals = problems.start.copy(), problems.goal.copy()
    starts[:6], goals[:6] = (np.stack(ends) for ends in zip(*cases, strict=True))
    paths = jax.tree.map(lambda leaf: leaf[:6], problems.plan(problems.keys, starts, goals))
    blocked = [PlanStatus.START_BLOCKED if i in (0, 3, 5) else PlanStatus.GOAL_BLOCKED for i in range(6)]
    np.testing.assert_array_equal(paths.status, blocked)
    assert np.all(np.isinf(paths.length)) and np.all(np.isfinite(paths.waypoints))


def _sample_motions(problems: PlanningProblems, count: int = 400):
    """Times, joints and velocities at `count` samples of each path's motion, and the trajectories."""

    def sample_motion(path):
        trajectory = time_path(problems.arm, path, CONFIG)
        times = jnp.linspace(0.0, 1.0, count) * trajectory.times[-1]
        joints, velocity = jax.vmap(lambda t: state_at(problems.arm, trajectory, t))(times)
        return times, joints, velocity, trajectory

    return jax.jit(jax.vmap(sample_motion))(problems.paths)


def _check_motions(problems: PlanningProblems) -> None:
    times, joints, velocity, trajectory = (jax.tree.map(np.asarray, part) for part in _sample_motions(problems))
    speed = np.asarray(problems.arm.speed)[:7]
    acceleration = speed / CONFIG.acceleration_time
    for i in np.flatnonzero(problems.found):
        step = times[i, 1]
        assert np.all(np.abs(velocity[i, :, :7]) <= speed * 1.001)
        # The mean acceleration between samples. Rounding in float32 leaves noise in a difference of velocities.
        change = np.diff(velocity[i, :, :7], axis=0) / step
        assert np.all(np.abs(change) <= acceleration * 1.02 + 1e-3 / step), i
        np.testing.assert_allclose(velocity[i, 0], 0.0, atol=1e-3)
        np.testing.assert_allclose(joints[i, 0], problems.start[i], atol=1e-5)
        np.testing.assert_allclose(joints[i, -1], problems.goal[i], atol=1e-4)
        mean = 0.5 * (velocity[i, 1:] + velocity[i, :-1]) * step
        slack = 0.25 * acceleration.max() * step**2 + 2e-5  # the acceleration may jump between two samples
        np.testing.assert_allclose(np.diff(joints[i], axis=0), mean, atol=slack)
        assert all(problems.oracle.is_free(q) for q in joints[i]), i
    assert np.all(np.isfinite(trajectory.times))


def test_motions_keep_the_limits_and_are_free(problems):
    _check_motions(problems)


def test_the_slowest_joint_sets_the_time_of_a_straight_motion(problems):
    path = jax.tree.map(lambda leaf: leaf[0], problems.paths)
    goal = problems.start[0].copy()
    goal[0] += 1.0
    waypoints = jnp.concatenate([problems.start[:1], jnp.repeat(goal[None], CONFIG.max_waypoints - 1, axis=0)])
    path = dataclasses.replace(path, waypoints=waypoints)
    trajectory = jax.jit(lambda p: time_path(problems.arm, p, CONFIG))(path)
    speed = float(problems.arm.speed[0])
    assert float(trajectory.times[-1]) == pytest.approx(1.0 / speed + CONFIG.acceleration_time, rel=0.03)


def test_errors_name_joints_without_limits(tmp_path):
    path = tmp_path / "arm.xml"
    path.write_text(MJCF)
    scene = build_scene(SceneConfig(arm=str(path), mount_height=1.0))
    arm = build_arm(scene)
    plan = Path(jnp.repeat(arm.home[None], 4, axis=0), jnp.float32(0.0), jnp.int32(PlanStatus.FOUND))
    with pytest.raises(PlanningError, match=r"no speed limit for joint arm/rail.*`user`"):
        time_path(arm, plan, CONFIG)
    path.write_text(MJCF.replace('name="elbow" axis="0 1 0" range="-2.4 2.4"', 'name="elbow" axis="0 1 0"'))
    with pytest.raises(SceneError, match=r"joint 'arm/elbow' has no limits"):
        build_arm(build_scene(SceneConfig(arm=str(path), mount_height=1.0)))


@pytest.mark.slow
def test_a_thousand_paths_are_free_and_keep_the_limits():
    problems = PlanningProblems(1100, 7)
    assert problems.found.sum() >= 1000
    _check_paths(problems)
    _check_motions(problems)
