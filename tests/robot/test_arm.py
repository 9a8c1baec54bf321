"""Kinematics and clearance of the arm equal those of C MuJoCo."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mujoco import mjx

from samples.second_arm import MJCF
from vsearch_jax.config import SceneConfig
from vsearch_jax.planning.starts import start_limits
from vsearch_jax.robot import (
    build_arm,
    camera_kinematics,
    camera_pose,
    clearance,
    collision,
    forward_kinematics,
    is_free,
)
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
    """A scene, its arm, random configurations inside the joint limits, and the results of the library for them."""

    def __init__(self, config: SceneConfig) -> None:
        self.scene = build_scene(config)
        self.arm = build_arm(self.scene)
        lower, upper = start_limits(self.arm)
        self.qpos = np.random.default_rng(0).uniform(lower, upper, (NUM_POSES, len(lower))).astype(np.float32)

        def evaluate_pose(qpos):
            data = forward_kinematics(self.arm, qpos)
            fields = {name: getattr(data, name) for name in FIELDS}
            pose = camera_pose(self.arm, data).as_matrix()
            return fields, pose, clearance(self.arm, data), is_free(self.arm, data)

        self.fields, self.pose, self.clearance, self.is_free = jax.jit(jax.vmap(evaluate_pose))(self.qpos)

    def oracle(self, index: int) -> mujoco.MjData:
        """Returns C MuJoCo's data at configuration `index`."""
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
    with jax.numpy_rank_promotion("allow"), jax.numpy_dtype_promotion("standard"):  # mjx promotes ranks and types
        # One configuration only: mjx.kinematics under vmap is too slow on CPU (see robot/kinematics.py).
        data = jax.jit(lambda qpos: mjx.kinematics(model, template.replace(qpos=qpos)))(lwr.qpos[0])
    for name in FIELDS[:-2]:  # mjx.kinematics does not compute cameras
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
    """Returns the minimum of mj_geomDistance over the pairs that can touch: table, object, self, in m."""
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
        is_parent_and_child = a not in fixed and b not in fixed and (parent(a) in welds or parent(b) in welds)
        return welds[0] != welds[1] and not is_parent_and_child and (bodies[0] << 16) + bodies[1] not in excluded

    def min_distance(others) -> float:
        return min(
            (mujoco.mj_geomDistance(model, data, a, b, 10.0, None) for a in moving for b in others if is_pair(a, b)),
            default=np.inf,
        )

    own = min_distance([*scene.arm_geom_ids, *scene.mount_geom_ids])
    return min_distance([scene.table_geom_id]), min_distance(scene.object_geom_ids), own


@pytest.mark.parametrize("name", ["teapot", "truck", "bracket"])
def test_clearance_equals_mujoco(name):
    setup = _Setup(SceneConfig(object=name, mount_height=1.0))
    for index in range(NUM_POSES):
        ours = [float(getattr(setup.clearance, part)[index]) for part in ("table", "object", "self")]
        # mj_geomDistance has an error up to 1e-4 for penetrating solids and for solids that are not capsules.
        np.testing.assert_allclose(ours, _mujoco_clearance(setup, index), atol=2e-4, err_msg=f"pose {index}")


def test_is_free_without_contact_and_with_table_clearance(lwr):
    expected = []
    for index in range(NUM_POSES):
        data = lwr.oracle(index)
        is_clear = data.ncon == 0 and _mujoco_clearance(lwr, index)[0] >= lwr.scene.table_clearance
        assert bool(lwr.is_free[index]) == is_clear
        expected.append(is_clear)
    assert 0 < sum(expected) < NUM_POSES


def test_clearance_of_other_solids_is_not_overestimated(second):
    for index in range(NUM_POSES):
        theirs = _mujoco_clearance(second, index)
        for part, distance in zip(("table", "object", "self"), theirs, strict=True):
            assert float(getattr(second.clearance, part)[index]) <= distance + 2e-4


def test_distance_without_an_object_is_infinite():
    setup = _Setup(SceneConfig())
    geoms = collision.Geoms(setup.scene.arm_geom_ids, (), (), ())
    pairs = collision.build_pairs(setup.scene.mj_model, setup.oracle(0), geoms, setup.scene.joint_ids, False)
    gap = collision.pair_distances(pairs, setup.fields["geom_xpos"][0], setup.fields["geom_xmat"][0], jnp.float32(0.0))
    assert np.isinf(collision.min_distance(pairs, gap, collision.OBJECT))
    assert np.isfinite(collision.min_distance(pairs, gap, collision.SELF))
