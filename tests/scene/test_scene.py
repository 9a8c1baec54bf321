"""The scene and its arm have the geometry and the names that the package relies on."""

import mujoco
import numpy as np
import pytest

from samples.second_arm import MJCF
from vsearch_jax.config import SceneConfig
from vsearch_jax.scene import SceneError, available, build_scene, xml_folder

# Data of the KUKA LWR 4+ (thesis, 3.1).
LIMITS_DEG = [170, 120, 170, 120, 170, 120, 170]
SPEEDS_DEG = [100, 110, 100, 130, 130, 180, 180]
TORQUES = [176, 176, 100, 100, 100, 38, 38]
AXES = [[0, 0, 1], [0, -1, 0], [0, 0, 1], [0, 1, 0], [0, 0, 1], [0, -1, 0], [0, 0, 1]]


@pytest.fixture(scope="module")
def lwr() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_path(str(xml_folder() / "arm" / "lwr.xml"))


def _bodies_of(model: mujoco.MjModel, prefix: str) -> list[int]:
    return [b for b in range(model.nbody) if model.body(b).name.startswith(prefix)]


def test_lwr_has_the_limits_of_the_data_sheet(lwr):
    assert (lwr.nq, lwr.nv, lwr.nu) == (9, 9, 9)
    np.testing.assert_allclose(np.rad2deg(lwr.jnt_range[:7]), [[-x, x] for x in LIMITS_DEG], rtol=1e-6)
    np.testing.assert_allclose(np.rad2deg(lwr.jnt_user[:7, 0]), SPEEDS_DEG, rtol=1e-4)
    np.testing.assert_array_equal(lwr.actuator_forcerange[:7], [[-x, x] for x in TORQUES])
    np.testing.assert_array_equal(lwr.actuator_ctrlrange, lwr.jnt_range)
    np.testing.assert_array_equal(lwr.jnt_axis[:7], AXES)
    assert set(lwr.jnt_type[7:]) == {int(mujoco.mjtJoint.mjJNT_SLIDE)}
    assert set(lwr.geom_type) == {int(mujoco.mjtGeom.mjGEOM_CAPSULE)}


def test_lwr_has_its_offsets_and_a_mass_of_16_kg(lwr):
    data = mujoco.MjData(lwr)
    mujoco.mj_forward(lwr, data)
    heights = [data.joint(name).xanchor[2] for name in ("A2", "A4", "A6")]
    np.testing.assert_allclose(heights, [0.3105, 0.7105, 1.1005], atol=1e-9)
    np.testing.assert_allclose(data.body("gripper").xpos, [0, 0, 1.1785], atol=1e-9)
    gripper = sum(lwr.body(name).mass[0] for name in ("gripper", "finger_left", "finger_right"))
    assert lwr.body_mass.sum() - gripper == pytest.approx(16.0)
    assert np.all(lwr.body_inertia[1:] > 0)


def test_the_camera_looks_along_the_tool_and_sees_no_geom_of_the_arm(lwr):
    data = mujoco.MjData(lwr)
    data.qpos[:] = lwr.jnt_range[:, 1] * 0.5
    mujoco.mj_forward(lwr, data)
    np.testing.assert_allclose(data.cam_xpos[0], data.site("tcp").xpos, atol=1e-12)
    forward = -data.cam_xmat[0].reshape(3, 3)[:, 2]
    np.testing.assert_allclose(forward, data.site("tcp").xmat.reshape(3, 3)[:, 2], atol=1e-12)
    # Each geom lies behind the camera's image plane, so no geom is visible.
    ends = np.abs(data.geom_xmat.reshape(-1, 3, 3)[:, :, 2] @ forward) * lwr.geom_size[:, 1] + lwr.geom_size[:, 0]
    assert np.all((data.geom_xpos - data.cam_xpos[0]) @ forward + ends < 0)


def test_actuators_hold_the_hanging_arm():
    model = build_scene(SceneConfig()).mj_model
    data = mujoco.MjData(model)
    target = np.array([0.3, 0.5, -0.2, 0.8, 0.1, -0.6, 0.4, 0.02, 0.02])
    data.qpos[:], data.ctrl[:] = target, target
    for _ in range(1000):
        mujoco.mj_step(model, data)
    np.testing.assert_allclose(data.qpos, target, atol=0.05)


def test_scene_lists_the_numbers_of_its_parts():
    scene = build_scene(SceneConfig())
    model = scene.mj_model
    assert [model.joint(j).name for j in scene.joint_ids] == [f"arm/A{i}" for i in range(1, 8)]
    assert model.camera(scene.camera_id).name == "arm/wrist"
    assert model.site(scene.tcp_site_id).name == "arm/tcp"
    assert set(model.geom_bodyid[list(scene.arm_geom_ids)]) == set(_bodies_of(model, "arm/"))
    assert set(model.geom_bodyid[list(scene.object_geom_ids)]) == set(_bodies_of(model, "object/"))
    ids = [
        *scene.arm_geom_ids,
        *scene.object_geom_ids,
        *scene.obstacle_geom_ids,
        *scene.mount_geom_ids,
        scene.table_geom_id,
    ]
    assert sorted(ids) == list(range(model.ngeom))
    assert model.light("main").castshadow[0] and not model.light("fill").castshadow[0]


def test_the_arm_hangs_at_the_height_of_the_config():
    scene = build_scene(SceneConfig(mount_height=1.1, radius=0.4, center_height=0.02))
    data = mujoco.MjData(scene.mj_model)
    mujoco.mj_forward(scene.mj_model, data)
    base = data.body("arm/base")
    np.testing.assert_allclose(base.xpos, [0, 0, 1.1], atol=1e-9)
    np.testing.assert_allclose(base.xmat.reshape(3, 3)[:, 2], [0, 0, -1], atol=1e-9)
    assert (scene.radius, scene.center[2]) == (0.4, 0.02)


@pytest.mark.parametrize("name", available("objects"))
def test_objects_are_low_and_have_many_colours(name):
    model = mujoco.MjModel.from_xml_path(str(xml_folder() / "objects" / f"{name}.xml"))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    down, hit = np.array([0.0, 0.0, -1.0]), np.zeros(1, np.int32)
    spots = [(x, y) for x in np.arange(-0.12, 0.12, 0.003) for y in np.arange(-0.12, 0.12, 0.003)]
    tops = np.array([1.0 - mujoco.mj_ray(model, data, [*spot, 1.0], down, None, 1, -1, hit) for spot in spots])
    bottoms = [mujoco.mj_ray(model, data, [*spot, -1.0], -down, None, 1, -1, hit) - 1.0 for spot in spots]
    covered = np.linalg.norm(np.array(spots)[tops <= 1.0], axis=1)
    assert 0.06 < tops[tops <= 1.0].max() <= 0.12
    assert np.min([z for z in bottoms if z > -1.5]) == pytest.approx(0.0, abs=0.001)
    assert 0.06 < covered.max() < 0.1  # The wrist camera's image is 0.2 m wide at the object.
    assert model.ngeom >= 6
    assert len({tuple(color) for color in model.geom_rgba}) >= 6


def test_at_least_three_objects_are_available():
    assert len(available("objects")) >= 3


def test_build_scene_takes_another_arm_and_removes_the_joints_of_the_object(tmp_path):
    arm, target = tmp_path / "arm.xml", tmp_path / "ball.xml"
    arm.write_text(MJCF)
    target.write_text('<mujoco><worldbody><body><freejoint/><geom size="0.05"/></body></worldbody></mujoco>')
    scene = build_scene(SceneConfig(arm=str(arm), object=str(target)))
    names = [scene.mj_model.joint(j).name.removeprefix("arm/") for j in scene.joint_ids]
    assert names == ["rail", "yaw", "pitch", "elbow", "roll", "tilt", "turn"]
    assert scene.mj_model.nq == 8


def test_loose_parts_are_fixed_and_equality_constraints_are_kept(tmp_path):
    path = tmp_path / "arm.xml"
    cup = '<body name="cup" pos="0.5 0.3 0.1"><freejoint name="loose"/><geom size="0.03"/></body></worldbody>'
    coupling = '<equality><joint joint1="lever" joint2="elbow" polycoef="0 0.5 0 0 0"/></equality>'
    path.write_text(MJCF.replace("</worldbody>", cup + coupling))
    scene = build_scene(SceneConfig(arm=str(path)))
    assert scene.mj_model.nq == 8 and scene.mj_model.neq == 1
    assert scene.mj_model.body("arm/cup").jntnum == 0


def test_obstacles_keep_the_positions_of_their_file():
    scene = build_scene(SceneConfig(obstacles="posts"))
    data = mujoco.MjData(scene.mj_model)
    mujoco.mj_forward(scene.mj_model, data)
    assert len(scene.obstacle_geom_ids) == 5
    np.testing.assert_allclose(data.geom("obstacle/shelf").xpos, [-0.5, 0, 0.45], atol=1e-9)
    with pytest.raises(SceneError, match=r"SceneConfig\.obstacles is 'fence'; available: posts"):
        build_scene(SceneConfig(obstacles="fence"))
