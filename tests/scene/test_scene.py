import re

import mujoco
import numpy as np
import pytest
import trimesh

from samples.second_arm import MJCF
from vsearch_jax.config import SceneConfig
from vsearch_jax.scene import Scene, SceneError, available, build_scene, xml_folder
from vsearch_jax.scene.meshes import inspect, read_mesh

# Thesis 3.1: KUKA LWR 4+.
LIMITS_DEG = [170, 120, 170, 120, 170, 120, 170]
SPEEDS_DEG = [100, 110, 100, 130, 130, 180, 180]
TORQUES = [176, 176, 100, 100, 100, 38, 38]
AXES = [[0, 0, 1], [0, -1, 0], [0, 0, 1], [0, 1, 0], [0, 0, 1], [0, -1, 0], [0, 0, 1]]
TETRAHEDRON = """
v 1.0 2.0 3.0
v 1.1 2.0 3.0
v 1.0 2.05 3.0
v 1.0 2.0 3.07
f 1 3 2
f 1 2 4
f 2 3 4
f 1 4 3
"""


@pytest.fixture(scope="module")
def lwr() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_path(str(xml_folder() / "arm" / "lwr.xml"))


def _placed_vertices(scene: Scene) -> np.ndarray:
    """The vertices of the object's mesh in world."""
    data = mujoco.MjData(scene.mj_model)
    mujoco.mj_forward(scene.mj_model, data)
    geom = scene.object_geom_ids[0]
    return scene.mj_model.mesh_vert @ data.geom_xmat[geom].reshape(3, 3).T + data.geom_xpos[geom]


def _bodies_of(model: mujoco.MjModel, prefix: str) -> list[int]:
    return [b for b in range(model.nbody) if model.body(b).name.startswith(prefix)]


def test_lwr_has_the_facts_of_the_data_sheet(lwr):
    assert (lwr.nq, lwr.nv, lwr.nu) == (9, 9, 9)
    np.testing.assert_allclose(np.rad2deg(lwr.jnt_range[:7]), [[-x, x] for x in LIMITS_DEG], rtol=1e-6)
    np.testing.assert_allclose(np.rad2deg(lwr.jnt_user[:7, 0]), SPEEDS_DEG, rtol=1e-4)
    np.testing.assert_array_equal(lwr.actuator_forcerange[:7], [[-x, x] for x in TORQUES])
    np.testing.assert_array_equal(lwr.actuator_ctrlrange, lwr.jnt_range)
    np.testing.assert_array_equal(lwr.jnt_axis[:7], AXES)
    assert set(lwr.jnt_type[7:]) == {int(mujoco.mjtJoint.mjJNT_SLIDE)}
    assert set(lwr.geom_type) == {int(mujoco.mjtGeom.mjGEOM_CAPSULE)}


def test_lwr_has_its_offsets_and_about_16_kg(lwr):
    data = mujoco.MjData(lwr)
    mujoco.mj_forward(lwr, data)
    heights = [data.joint(name).xanchor[2] for name in ("A2", "A4", "A6")]
    np.testing.assert_allclose(heights, [0.3105, 0.7105, 1.1005], atol=1e-9)
    np.testing.assert_allclose(data.body("gripper").xpos, [0, 0, 1.1785], atol=1e-9)
    gripper = sum(lwr.body(name).mass[0] for name in ("gripper", "finger_left", "finger_right"))
    assert lwr.body_mass.sum() - gripper == pytest.approx(16.0)
    assert np.all(lwr.body_inertia[1:] > 0)


def test_the_camera_looks_along_the_tool_past_the_gripper(lwr):
    data = mujoco.MjData(lwr)
    data.qpos[:] = lwr.jnt_range[:, 1] * 0.5
    mujoco.mj_forward(lwr, data)
    np.testing.assert_allclose(data.cam_xpos[0], data.site("tcp").xpos, atol=1e-12)
    forward = -data.cam_xmat[0].reshape(3, 3)[:, 2]
    np.testing.assert_allclose(forward, data.site("tcp").xmat.reshape(3, 3)[:, 2], atol=1e-12)
    # Every geom ends behind the plane of the camera: none can be in the picture.
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


def test_scene_knows_its_parts():
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
def test_objects_stand_low_on_the_table_and_are_made_of_many_colours(name):
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
    assert 0.06 < covered.max() < 0.1  # the picture is 0.2 m wide there
    assert model.ngeom >= 6
    assert len({tuple(color) for color in model.geom_rgba}) >= 6


def test_there_are_three_objects():
    assert len(available("objects")) >= 3


def test_a_mesh_stands_in_the_middle_of_the_table(tmp_path):
    path = tmp_path / "part.obj"
    path.write_text(TETRAHEDRON)
    scene = build_scene(SceneConfig(object=str(path)))
    vertices = _placed_vertices(scene)
    np.testing.assert_allclose(vertices.min(axis=0), [-0.05, -0.025, 0], atol=1e-6)
    np.testing.assert_allclose(vertices.max(axis=0), [0.05, 0.025, 0.07], atol=1e-6)


def test_another_arm_and_an_object_with_a_joint_fit_too(tmp_path):
    arm, target = tmp_path / "arm.xml", tmp_path / "ball.xml"
    arm.write_text(MJCF)
    target.write_text('<mujoco><worldbody><body><freejoint/><geom size="0.05"/></body></worldbody></mujoco>')
    scene = build_scene(SceneConfig(arm=str(arm), object=str(target)))
    names = [scene.mj_model.joint(j).name.removeprefix("arm/") for j in scene.joint_ids]
    assert names == ["rail", "yaw", "pitch", "elbow", "roll", "tilt", "turn"]
    assert scene.mj_model.nq == 8


def test_loose_parts_stand_still_and_coupled_joints_are_kept(tmp_path):
    path = tmp_path / "arm.xml"
    cup = '<body name="cup" pos="0.5 0.3 0.1"><freejoint name="loose"/><geom size="0.03"/></body></worldbody>'
    coupling = '<equality><joint joint1="lever" joint2="elbow" polycoef="0 0.5 0 0 0"/></equality>'
    path.write_text(MJCF.replace("</worldbody>", cup + coupling))
    scene = build_scene(SceneConfig(arm=str(path)))
    assert scene.mj_model.nq == 8 and scene.mj_model.neq == 1
    assert scene.mj_model.body("arm/cup").jntnum == 0


def test_obstacles_stand_where_their_file_has_them():
    scene = build_scene(SceneConfig(obstacles="posts"))
    data = mujoco.MjData(scene.mj_model)
    mujoco.mj_forward(scene.mj_model, data)
    assert len(scene.obstacle_geom_ids) == 5
    np.testing.assert_allclose(data.geom("obstacle/shelf").xpos, [-0.5, 0, 0.45], atol=1e-9)
    with pytest.raises(SceneError, match="unknown obstacles 'fence'; available: posts"):
        build_scene(SceneConfig(obstacles="fence"))


@pytest.mark.parametrize(
    ("part", "content", "words"),
    [
        ("object", None, ["object", "does not exist", "teapot"]),
        ("arm", None, ["arm", "does not exist", "lwr"]),
        ("object", "<mujoco><worldbody/></mujoco>", ["has no geom"]),
        ("object", "<mujoco><world/></mujoco>", ["cannot be loaded", "unrecognized element"]),
        ("arm", MJCF.replace('name="tcp"', ""), ["no site named 'tcp'"]),
        ("arm", MJCF.replace('<camera name="wrist"', '<camera name="eye"'), ["no camera named 'wrist'"]),
        (
            "arm",
            '<mujoco><worldbody><body><geom size="1"/><site name="tcp"/><camera name="wrist"/></body></worldbody>'
            "</mujoco>",
            ["no joint that moves the camera"],
        ),
        (
            "arm",
            '<mujoco><worldbody><body><freejoint name="fly"/><geom size="1"/><site name="tcp"/><camera name="wrist"/>'
            "</body></worldbody></mujoco>",
            ["'fly'", "is free or a ball"],
        ),
    ],
)
def test_a_bad_file_is_told_in_one_line(tmp_path, part, content, words):
    path = tmp_path / "file.xml"
    if content is not None:
        path.write_text(content)
    with pytest.raises(SceneError) as caught:
        build_scene(SceneConfig(**{part: str(path)}))
    message = str(caught.value)
    assert "\n" not in message
    for word in [str(path), *words]:
        assert word in message


@pytest.mark.parametrize("suffix", ["obj", "stl", "ply", "glb", "off"])
def test_meshes_of_every_format_stand_alike(tmp_path, suffix, caplog):
    path = tmp_path / f"part.{suffix}"
    shape = trimesh.creation.box((0.1, 0.06, 0.04), transform=trimesh.transformations.translation_matrix((3, 4, 5)))
    path.write_bytes(as_bytes(shape.export(file_type=suffix)))
    scene = build_scene(SceneConfig(object=str(path)))
    vertices = _placed_vertices(scene)
    np.testing.assert_allclose(vertices.min(axis=0), [-0.05, -0.03, 0], atol=1e-6)
    np.testing.assert_allclose(vertices.max(axis=0), [0.05, 0.03, 0.04], atol=1e-6)
    assert not caplog.records


def as_bytes(exported: str | bytes) -> bytes:
    return exported.encode() if isinstance(exported, str) else exported


def test_a_mesh_with_holes_is_taken_and_reported(tmp_path, caplog):
    shape = trimesh.creation.box((0.1, 0.06, 0.04))
    faces = np.concatenate([shape.faces[1:], [[0, 0, 1]]])
    path = tmp_path / "part.ply"
    path.write_bytes(trimesh.Trimesh(shape.vertices, faces, process=False).export(file_type="ply"))
    assert (
        str(inspect(*read_mesh(path))) == "12 faces, 1 of them without area, 3 edges at holes, size 0.1 x 0.06 x 0.04"
    )
    build_scene(SceneConfig(object=str(path)))
    assert "3 edges at holes" in caplog.text


@pytest.mark.parametrize(
    ("size", "words"), [(85.0, "85 m long.*millimetres.*0.001"), (1e-3, "0.001 m long.*mesh_scale")]
)
def test_a_mesh_of_another_unit_is_told(tmp_path, size, words):
    path = tmp_path / "part.stl"
    path.write_bytes(trimesh.creation.box((size, size, size)).export(file_type="stl"))
    with pytest.raises(SceneError, match=rf"part\.stl.*{words}"):
        build_scene(SceneConfig(object=str(path)))


@pytest.mark.parametrize("suffix", ["stl", "ply"])
def test_a_mesh_is_scaled_and_stays_where_its_file_has_it_if_wanted(tmp_path, suffix):
    path = tmp_path / f"part.{suffix}"
    shape = trimesh.creation.box((100, 60, 40), transform=trimesh.transformations.translation_matrix((10, 20, 30)))
    path.write_bytes(as_bytes(shape.export(file_type=suffix)))
    scene = build_scene(SceneConfig(object=str(path), mesh_scale=0.001, is_mesh_recentred=False))
    vertices = _placed_vertices(scene)
    np.testing.assert_allclose(vertices.min(axis=0), [-0.04, -0.01, 0.01], atol=1e-6)
    np.testing.assert_allclose(vertices.max(axis=0), [0.06, 0.05, 0.05], atol=1e-6)


def test_a_plane_that_the_arm_could_touch_is_refused(tmp_path):
    path = tmp_path / "wall.xml"
    wall = '<mujoco><worldbody><geom name="wall" type="plane" size="1 1 .1" pos="1 0 0" {bits}/></worldbody></mujoco>'
    path.write_text(wall.format(bits=""))
    with pytest.raises(SceneError, match=r"geom 'obstacle/wall' .* is a plane.*make it a box"):
        build_scene(SceneConfig(obstacles=str(path)))
    path.write_text(wall.format(bits='contype="0" conaffinity="0"'))
    assert len(build_scene(SceneConfig(obstacles=str(path))).obstacle_geom_ids) == 1


def test_a_wrist_camera_that_sees_no_central_square_is_refused(tmp_path):
    path = tmp_path / "arm.xml"
    text = (xml_folder() / "arm" / "lwr.xml").read_text()
    for attributes, is_fine in (
        ('projection="orthographic"', False),
        ('focal=".01 .01" sensorsize=".008 .006" resolution="64 48"', False),
        ('focal=".01 .01" sensorsize=".006 .006" principal=".001 0" resolution="64 64"', False),
        ('focal=".01 .01" sensorsize=".006 .006" resolution="64 64"', True),
    ):
        path.write_text(re.sub(r'(<camera name="wrist"[^>]*?) fovy="[^"]*"', rf"\1 {attributes}", text))
        if is_fine:
            assert build_scene(SceneConfig(arm=str(path))).mj_model.ncam
        else:
            with pytest.raises(SceneError, match="camera 'wrist' is orthographic or its sensor"):
                build_scene(SceneConfig(arm=str(path)))


def test_a_bad_mesh_and_an_unknown_name_are_told(tmp_path):
    path = tmp_path / "part.stl"
    path.write_text("no mesh")
    with pytest.raises(SceneError, match=r"part\.stl.*cannot be loaded"):
        build_scene(SceneConfig(object=str(path)))
    with pytest.raises(SceneError, match="unknown object 'teepot'; available: bracket, teapot, truck"):
        build_scene(SceneConfig(object="teepot"))
    with pytest.raises(SceneError, match="unknown arm 'kuka'; available: lwr, ur5e"):
        build_scene(SceneConfig(arm="kuka"))
