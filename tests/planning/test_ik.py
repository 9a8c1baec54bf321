"""Inverse kinematics and the reachability map, compared with C MuJoCo and with the geometry of the LWR."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from jaxlie import SE3

from samples.second_arm import MJCF
from vsearch_jax.config import IKConfig, SceneConfig
from vsearch_jax.geometry import view_pose
from vsearch_jax.planning import ik, ik_from_starts, nearest_cell, reachability_map, solve_view, start_limits
from vsearch_jax.planning.starts import ranking_cost
from vsearch_jax.robot.arm import build_arm, camera_pose, forward_kinematics
from vsearch_jax.scene import build_scene
from vsearch_jax.types import IKResult, IKStatus, View

CONFIG = IKConfig(map_azimuths=12, map_elevations=19, map_seeds=16)
NUM_POSES = 2000
# Distance in m from shoulder to wrist of the LWR: with the arm stretched, and with A4 at its limit of 120 degrees.
FARTHEST = 0.79
NEAREST = np.sqrt(0.4**2 + 0.39**2 - 2 * 0.4 * 0.39 * np.cos(np.deg2rad(60)))


@pytest.fixture(scope="module")
def scene():
    return build_scene(SceneConfig())


@pytest.fixture(scope="module")
def arm(scene):
    return build_arm(scene)


@pytest.fixture(scope="module")
def sphere(scene):
    return jnp.asarray(scene.center, jnp.float32), jnp.float32(scene.radius)


@jax.jit
def _compute_map(arm, center, radius):
    return reachability_map(arm, center, radius, CONFIG, jax.random.key(0))


@pytest.fixture(scope="module")
def reach(arm, sphere):
    return _compute_map(arm, *sphere)


def _random_joints(arm, seed: int, count: int) -> np.ndarray:
    lower, upper = start_limits(arm)
    return np.random.default_rng(seed).uniform(lower, upper, (count, len(lower))).astype(np.float32)


def _errors(scene, qpos, poses) -> np.ndarray:
    """Position (m) and rotation (rad) errors of the camera, by C MuJoCo."""
    data, errors = mujoco.MjData(scene.mj_model), []
    for joints, pose in zip(qpos, poses, strict=True):
        data.qpos[:] = joints
        mujoco.mj_fwdPosition(scene.mj_model, data)
        relative = data.cam_xmat[scene.camera_id].reshape(3, 3).T @ pose[:3, :3]
        angle = np.arccos(np.clip((np.trace(relative) - 1) / 2, -1, 1))
        errors.append([np.linalg.norm(data.cam_xpos[scene.camera_id] - pose[:3, 3]), angle])
    return np.array(errors)


@functools.cache
def _solve_all_lwr(config):
    return _solve_all(build_arm(build_scene(SceneConfig())), config)


def _solve_all(arm, config):
    def pose(qpos):
        return camera_pose(arm, forward_kinematics(arm, qpos))

    poses = jax.jit(jax.vmap(pose))(_random_joints(arm, 1, NUM_POSES))
    present = _random_joints(arm, 2, NUM_POSES)
    result = jax.jit(jax.vmap(lambda pose, q: ik(arm, pose, q, config)))(poses, present)
    return poses, present, result


def test_ik_solves_poses_that_are_reachable_by_construction(scene, arm):
    poses, present, result = _solve_all_lwr(CONFIG)
    solved = np.asarray(result.is_converged)
    assert solved.mean() >= 0.995
    np.testing.assert_array_equal(np.asarray(result.status) == IKStatus.SOLVED, solved)
    errors = _errors(scene, result.qpos, np.asarray(poses.as_matrix()))
    assert np.all(errors[solved, 0] < CONFIG.position_tolerance + 1e-6)
    assert np.all(errors[solved, 1] < np.deg2rad(CONFIG.rotation_tolerance_deg) + 1e-6)
    np.testing.assert_allclose(result.position_error, errors[:, 0], atol=1e-5)
    np.testing.assert_allclose(result.rotation_error, errors[:, 1], atol=2e-3)
    assert np.all(result.qpos >= arm.lower[None]) and np.all(result.qpos <= arm.upper[None])
    np.testing.assert_array_equal(result.qpos[:, 7:], present[:, 7:])  # the fingers do not move


@pytest.mark.slow
def test_ik_solves_another_arm(tmp_path):
    path = tmp_path / "second.xml"
    path.write_text(MJCF)
    scene = build_scene(SceneConfig(arm=str(path), mount_height=1.0))
    arm = build_arm(scene)
    poses, present, result = _solve_all(arm, CONFIG)
    solved = np.asarray(result.is_converged)
    assert solved.mean() >= 0.98
    assert np.all(_errors(scene, result.qpos, np.asarray(poses.as_matrix()))[solved, 0] < 1.001e-3)
    branch = scene.mj_model.joint("arm/lever").id
    np.testing.assert_array_equal(result.qpos[:, branch], present[:, branch])


@pytest.mark.slow
def test_ik_solves_six_axes():
    scene = build_scene(SceneConfig(arm="ur5e"))
    arm = build_arm(scene)
    poses, _, result = _solve_all(arm, CONFIG)
    solved = np.asarray(result.is_converged)
    assert solved.mean() >= 0.99
    assert np.all(_errors(scene, result.qpos, np.asarray(poses.as_matrix()))[solved, 0] < 1.001e-3)


def test_nullspace_steps_bring_the_arm_near_and_off_its_limits(arm):
    def travel_and_share_at_limits(config):
        _, present, result = _solve_all_lwr(config)
        solved = np.asarray(result.is_converged)
        joints, lower, upper = (np.asarray(x)[..., :7] for x in (result.qpos, arm.lower, arm.upper))
        margin = np.minimum(joints - lower, upper - joints).min(axis=-1)
        return np.linalg.norm(result.qpos - present, axis=1)[solved].mean(), np.mean(margin[solved] < 1e-4)

    travel, at_limits = travel_and_share_at_limits(dataclasses.replace(CONFIG, num_nullspace_steps=0))
    less_travel, less_at_limits = travel_and_share_at_limits(CONFIG)
    assert less_travel < travel
    assert less_at_limits < at_limits


@pytest.mark.slow
def test_a_free_roll_aligns_only_the_optical_axis(scene):
    config = dataclasses.replace(CONFIG, is_roll_free=True)
    poses, present, result = _solve_all_lwr(config)
    _, _, fixed = _solve_all_lwr(CONFIG)
    solved = np.asarray(result.is_converged)
    assert solved.mean() >= 0.995
    data, model = mujoco.MjData(scene.mj_model), scene.mj_model
    for index in np.flatnonzero(solved)[:100]:
        data.qpos[:] = result.qpos[index]
        mujoco.mj_fwdPosition(model, data)
        wanted = np.asarray(poses.as_matrix()[index])
        axis = data.cam_xmat[scene.camera_id].reshape(3, 3)[:, 2]
        assert np.linalg.norm(np.cross(axis, wanted[:3, 2])) < np.sin(np.deg2rad(0.101))
        assert np.linalg.norm(data.cam_xpos[scene.camera_id] - wanted[:3, 3]) < 1.001e-3
    near, far = (np.linalg.norm(r.qpos - present, axis=1)[solved].mean() for r in (result, fixed))
    assert near < 0.9 * far


def test_ik_from_starts_returns_the_solution_nearest_to_the_present_joints(arm):
    start = jnp.asarray([0.2, 0.6, -0.3, 1.1, 0.4, -0.7, 0.5, 0.01, 0.03])
    pose = camera_pose(arm, forward_kinematics(arm, start))
    far = jnp.asarray([-2.9, -0.6, 2.8, -1.1, -2.7, 0.7, -2.6, 0.01, 0.03])
    result, _ = jax.jit(lambda starts: ik_from_starts(arm, pose, starts, start, CONFIG))(jnp.stack([far, start]))
    np.testing.assert_allclose(result.qpos, start, atol=1e-3)


def test_ranking_cost_orders_valid_then_converged_then_others():
    error = jnp.asarray([0.0, 0.0, 0.0, 0.2, 0.1, jnp.nan])
    is_converged = jnp.asarray([True, True, True, False, False, False])
    status = jnp.zeros(6, jnp.int32)
    results = IKResult(jnp.zeros((6, 9)), error, error, is_converged, status)
    is_valid = jnp.asarray([False, True, True, False, False, False])
    travel = jnp.asarray([0.0, 2.0, 1.0, 0.0, 3.0, 0.0])
    np.testing.assert_array_equal(jnp.argsort(ranking_cost(results, is_valid, travel)), [2, 1, 0, 4, 3, 5])


def test_unsolvable_poses_and_nan_joints_give_a_status_and_finite_joints(arm):
    solve = jax.jit(lambda pose, q: ik(arm, pose, q, dataclasses.replace(CONFIG, num_seeds=2)))
    far = SE3.from_translation(jnp.asarray([5.0, 0.0, 0.0]))
    nan = SE3.from_translation(jnp.asarray([jnp.nan, 0.0, 0.0]))
    for pose, qpos in ((far, arm.home), (nan, arm.home), (far, arm.home * jnp.nan)):
        result = solve(pose, qpos)
        assert not result.is_converged
        is_finite = bool(jnp.all(jnp.isfinite(qpos)) & jnp.all(jnp.isfinite(pose.translation())))
        assert result.status == (IKStatus.UNREACHABLE if is_finite else IKStatus.NOT_FINITE)
        assert np.all(np.isfinite(result.qpos))
        assert np.all(result.qpos >= arm.lower) and np.all(result.qpos <= arm.upper)


def test_map_equals_the_reach_from_shoulder_to_wrist(scene, reach, sphere):
    center, radius = sphere
    elevations = np.asarray(reach.elevations)
    tool = 0.078 + 0.3
    wrist = np.stack([np.cos(elevations), np.sin(elevations)], axis=1) * (float(radius) + tool)
    shoulder = np.array([0.0, SceneConfig().mount_height - 0.3105 - float(center[2])])
    distance = np.linalg.norm(wrist - shoulder, axis=1)
    is_within = (distance <= FARTHEST) & (distance >= NEAREST)
    np.testing.assert_array_equal(reach.is_reachable, np.broadcast_to(is_within, reach.is_reachable.shape))


def test_band_of_the_default_mount_is_that_of_the_thesis(reach):
    np.testing.assert_allclose(np.rad2deg(reach.band), [40.0, 70.0], atol=1e-3)


def test_reachable_cells_are_solved_and_free_in_mujoco(scene, reach, sphere):
    views = View(*(grid.ravel() for grid in jnp.meshgrid(reach.azimuths, reach.elevations, indexing="ij")))
    poses = np.asarray(jax.vmap(lambda view: view_pose(view, *sphere).as_matrix())(views))
    is_reachable = np.asarray(reach.is_reachable).ravel()
    qpos = np.asarray(reach.qpos).reshape(-1, 9)
    errors = _errors(scene, qpos[is_reachable], poses[is_reachable])
    assert np.all(errors[:, 0] < 1.001e-3) and np.all(errors[:, 1] < np.deg2rad(0.101))
    model, data = scene.mj_model, mujoco.MjData(scene.mj_model)
    for joints in qpos[is_reachable]:
        assert np.all(joints >= model.jnt_range[:, 0]) and np.all(joints <= model.jnt_range[:, 1])
        data.qpos[:] = joints
        mujoco.mj_fwdPosition(model, data)
        assert data.ncon == 0
    assert np.all(np.isfinite(qpos))


def test_every_view_of_the_band_is_solved_from_any_other_and_none_outside(arm, reach, sphere):
    random = np.random.default_rng(3)
    count = 128
    azimuth = jnp.asarray(random.uniform(-np.pi, np.pi, count), jnp.float32)
    elevation = jnp.asarray(np.deg2rad(random.uniform(40, 70, count)), jnp.float32)
    present = jax.vmap(lambda a, e: reach.qpos[nearest_cell(reach, View(a, e))])(azimuth[::-1], elevation[::-1])
    solve = jax.jit(jax.vmap(lambda a, e, q: solve_view(arm, reach, View(a, e), q, sphere, CONFIG)))
    result, is_reachable = solve(azimuth, elevation, present)
    assert np.all(is_reachable) and np.all(result.is_converged)
    for outside in (30.0, 78.0):
        _, is_reachable = solve(azimuth, jnp.full_like(elevation, np.deg2rad(outside)), present)
        assert not np.any(is_reachable)


def test_nearest_cell_wraps_around_and_skips_unreachable_cells(reach):
    step = 2 * np.pi / CONFIG.map_azimuths
    assert nearest_cell(reach, View(jnp.float32(-0.1 * step), jnp.float32(np.deg2rad(51)))) == (0, 10)
    assert nearest_cell(reach, View(jnp.float32(2.2 * step), jnp.float32(0.0))) == (2, 8)


def test_an_arm_that_reaches_nothing_has_no_band(sphere):
    reach = _compute_map(build_arm(build_scene(SceneConfig(mount_height=3.0))), *sphere)
    assert not np.any(reach.is_reachable)
    assert np.all(np.isnan(reach.band))
