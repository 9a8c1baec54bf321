import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mujoco import mjx

from samples.second_arm import MJCF
from vsearch_jax.config import SceneConfig
from vsearch_jax.planning.starts import start_limits
from vsearch_jax.robot import collision
from vsearch_jax.robot.arm import build_arm, camera_kinematics, camera_pose, clearance, forward_kinematics, is_free
from vsearch_jax.robot.collision import primitives
from vsearch_jax.scene import build_scene

FIELDS = (
    "xpos",
    "xmat",
    "xanchor",
    "xaxis",
    "geom_xpos",
    "geom_xmat",
    "site_xpos",
    "site_xmat",
    "cam_xpos",
    "cam_xmat",
)
NUM_POSES = 32


class _Setup:
    """A scene, its arm, random joints inside the limits, and what the library says of them."""

    def __init__(self, config: SceneConfig) -> None:
        self.scene = build_scene(config)
        self.arm = build_arm(self.scene)
        lower, upper = start_limits(self.arm)
        self.qpos = np.random.default_rng(0).uniform(lower, upper, (NUM_POSES, len(lower))).astype(np.float32)

        def look(qpos):
            data = forward_kinematics(self.arm, qpos)
            fields = {name: getattr(data, name) for name in FIELDS}
            pose = camera_pose(self.arm, data).as_matrix()
            return fields, pose, clearance(self.arm, data), is_free(self.arm, data)

        self.fields, self.pose, self.clearance, self.is_free = jax.jit(jax.vmap(look))(self.qpos)

    def oracle(self, index: int) -> mujoco.MjData:
        data = mujoco.MjData(self.scene.mj_model)
        data.qpos[:] = self.qpos[index]
        mujoco.mj_fwdPosition(self.scene.mj_model, data)
        return data


@pytest.fixture(scope="module")
def lwr() -> _Setup:
    return _Setup(SceneConfig())


@pytest.fixture(scope="module")
def second(tmp_path_factory) -> _Setup:
    path = tmp_path_factory.mktemp("arm") / "second.xml"
    path.write_text(MJCF)
    return _Setup(SceneConfig(arm=str(path), mount_height=1.0, object="truck"))


@pytest.fixture(params=["lwr", "second"])
def setup(request) -> _Setup:
    return request.getfixturevalue(request.param)


def test_kinematics_equal_mujoco(setup):
    for index in range(NUM_POSES):
        data = setup.oracle(index)
        for name in FIELDS:
            ours = setup.fields[name][index]
            theirs = getattr(data, name).reshape(ours.shape)
            np.testing.assert_allclose(ours, theirs, atol=1e-5, err_msg=name)
        camera = setup.scene.camera_id
        np.testing.assert_allclose(setup.pose[index, :3, 3], data.cam_xpos[camera], atol=1e-5)
        np.testing.assert_allclose(setup.pose[index, :3, :3], data.cam_xmat[camera].reshape(3, 3), atol=1e-5)


def test_kinematics_equal_mjx(lwr):
    model, template = lwr.scene.mjx_model, lwr.arm.data
    with jax.numpy_rank_promotion("allow"), jax.numpy_dtype_promotion("standard"):  # mjx promotes freely
        # One configuration: vmapped, mjx.kinematics is too slow on CPU, see vsearch_jax/kinematics.py.
        data = jax.jit(lambda qpos: mjx.kinematics(model, template.replace(qpos=qpos)))(lwr.qpos[0])
    for name in FIELDS[:-2]:  # mjx.kinematics places no cameras
        ours = lwr.fields[name][0]
        np.testing.assert_allclose(ours, np.reshape(getattr(data, name), ours.shape), atol=1e-5, err_msg=name)


def test_jacobian_equals_mujoco(setup):
    address = np.array(setup.scene.qpos_addresses)
    position, rotation, jacobian = jax.jit(jax.vmap(lambda q: camera_kinematics(setup.arm, q)))(setup.qpos[:, address])
    model = setup.scene.mj_model
    for index in range(NUM_POSES):
        data = setup.oracle(index)
        linear, angular = np.zeros((3, model.nv)), np.zeros((3, model.nv))
        camera = setup.scene.camera_id
        mujoco.mj_jac(model, data, linear, angular, data.cam_xpos[camera], model.cam_bodyid[camera])
        np.testing.assert_allclose(jacobian[index], np.vstack([linear, angular])[:, address], atol=1e-5)
        np.testing.assert_allclose(position[index], data.cam_xpos[camera], atol=1e-5)
        np.testing.assert_allclose(rotation[index], data.cam_xmat[camera].reshape(3, 3), atol=1e-5)


def _mujoco_clearance(setup, index: int) -> tuple[float, float, float]:
    """Least mj_geomDistance of the pairs that MuJoCo's own collision detection lets touch."""
    scene, data = setup.scene, setup.oracle(index)
    model = scene.mj_model
    fixed = {g for g in range(model.ngeom) if model.body_weldid[model.geom_bodyid[g]] == 0}
    moving = [g for g in scene.arm_geom_ids if g not in fixed]
    excluded = set(model.exclude_signature.tolist())

    def parent(geom: int) -> int:
        return model.body_weldid[model.body_parentid[model.body_weldid[model.geom_bodyid[geom]]]]

    def is_pair(a: int, b: int) -> bool:
        bodies = sorted((int(model.geom_bodyid[a]), int(model.geom_bodyid[b])))
        welds = model.body_weldid[bodies]
        is_family = a not in fixed and b not in fixed and (parent(a) in welds or parent(b) in welds)
        return welds[0] != welds[1] and not is_family and (bodies[0] << 16) + bodies[1] not in excluded

    def least(others) -> float:
        return min(
            (mujoco.mj_geomDistance(model, data, a, b, 10.0, None) for a in moving for b in others if is_pair(a, b)),
            default=np.inf,
        )

    own = least([*scene.arm_geom_ids, *scene.mount_geom_ids])
    return least([scene.table_geom_id]), least(scene.object_geom_ids), own


@pytest.mark.parametrize("name", ["teapot", "truck", "bracket"])
def test_clearance_equals_mujoco(name):
    setup = _Setup(SceneConfig(object=name, mount_height=1.0))
    for index in range(NUM_POSES):
        ours = [float(getattr(setup.clearance, part)[index]) for part in ("table", "object", "self")]
        # mj_geomDistance stops within 1e-4 where solids penetrate or are no capsules.
        np.testing.assert_allclose(ours, _mujoco_clearance(setup, index), atol=2e-4, err_msg=f"pose {index}")


def test_free_is_without_contact_and_above_the_clearance(lwr):
    found = []
    for index in range(NUM_POSES):
        data = lwr.oracle(index)
        is_clear = data.ncon == 0 and _mujoco_clearance(lwr, index)[0] >= lwr.scene.table_clearance
        assert bool(lwr.is_free[index]) == is_clear
        found.append(is_clear)
    assert 0 < sum(found) < NUM_POSES


def test_clearance_of_other_solids_is_on_the_safe_side(second):
    for index in range(NUM_POSES):
        theirs = _mujoco_clearance(second, index)
        for part, distance in zip(("table", "object", "self"), theirs, strict=True):
            assert float(getattr(second.clearance, part)[index]) <= distance + 2e-4


def test_a_missing_object_leaves_its_distance_infinite():
    setup = _Setup(SceneConfig())
    geoms = collision.Geoms(setup.scene.arm_geom_ids, (), (), ())
    pairs = collision.build_pairs(setup.scene.mj_model, setup.oracle(0), geoms, setup.scene.joint_ids, False)
    gap = collision.pair_distances(pairs, setup.fields["geom_xpos"][0], setup.fields["geom_xmat"][0], jnp.float32(0.0))
    assert np.isinf(collision.min_distance(pairs, gap, collision.OBJECT))
    assert np.isfinite(collision.min_distance(pairs, gap, collision.SELF))


_coordinate = st.floats(-0.5, 0.5, width=32)
_point = st.tuples(_coordinate, _coordinate, _coordinate).map(lambda p: jnp.asarray(p, jnp.float32))
_size = st.tuples(*[st.floats(0.01, 0.3)] * 3).map(lambda s: jnp.asarray(s, jnp.float32))
_SOLIDS = {
    "box": (mujoco.mjtGeom.mjGEOM_BOX, primitives.segment_box_distance),
    "cylinder": (
        mujoco.mjtGeom.mjGEOM_CYLINDER,
        lambda c, h, s: primitives.segment_cylinder_distance(c, h, s[0], s[1]),
    ),
    "ellipsoid": (
        mujoco.mjtGeom.mjGEOM_ELLIPSOID,
        lambda c, h, s: primitives.least_along(lambda point: primitives.ellipsoid_distance(point, s), c, h),
    ),
}
_PROBE = 1e-4


@pytest.fixture(scope="module", params=list(_SOLIDS))
def solid(request):
    kind, distance = _SOLIDS[request.param]
    return kind, jax.jit(lambda c, h, s: distance(*(tuple(x[:, None]) for x in (c, h, s)))[0])


@given(point=_point, size=_size)
def test_distance_of_a_point_from_a_solid_equals_mujoco(solid, point, size):
    kind, distance = solid
    spec = mujoco.MjSpec()
    spec.worldbody.add_geom(type=kind, size=np.asarray(size, float))
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[_PROBE, 0, 0], pos=np.asarray(point, float))
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    theirs = mujoco.mj_geomDistance(model, data, 0, 1, 10.0, None) + _PROBE
    ours = float(distance(point, jnp.zeros(3), size))
    if theirs > _PROBE:
        assert ours == pytest.approx(theirs, abs=2e-4)
    else:  # how deep a penetration is, MuJoCo only estimates
        assert ours < 2 * _PROBE


@pytest.mark.parametrize("solid", ["box", "cylinder"], indirect=True)
@given(center=_point, half_axis=_point, size=_size)
def test_distance_of_a_segment_from_a_solid_is_the_least_of_its_points(solid, center, half_axis, size):
    kind, distance = solid
    middle, half = np.asarray(center, float), np.asarray(half_axis, float)
    points = middle + np.linspace(-1, 1, 20_001)[:, None] * half
    beyond = np.abs(points) - np.asarray(size)
    if kind == mujoco.mjtGeom.mjGEOM_CYLINDER:
        beyond = np.stack([np.hypot(*points.T[:2]) - float(size[0]), np.abs(points[:, 2]) - float(size[1])], axis=1)
    sampled = np.linalg.norm(np.maximum(beyond, 0.0), axis=1).min()
    spacing = 0.5e-4 * np.linalg.norm(half)
    short = 3e-4 if kind == mujoco.mjtGeom.mjGEOM_CYLINDER else 2e-6  # of a segment up to 1.7 m long
    assert sampled - spacing - short <= float(distance(center, half_axis, size)) <= sampled + 2e-6


@given(a=_point, u=_point, b=_point, v=_point)
def test_distance_of_segments_is_the_least_over_both(a, u, b, v):
    ours = float(_segment_distance(a, u, b, v))
    s = np.linspace(-1, 1, 101)[:, None, None]
    t = np.linspace(-1, 1, 101)[None, :, None]
    sampled = np.linalg.norm((np.asarray(a) + s * np.asarray(u)) - (np.asarray(b) + t * np.asarray(v)), axis=-1).min()
    spacing = 0.01 * (np.linalg.norm(u) + np.linalg.norm(v))
    assert sampled - spacing - 1e-4 <= ours <= sampled + 1e-4


_segment_distance = jax.jit(primitives.segment_distance)
