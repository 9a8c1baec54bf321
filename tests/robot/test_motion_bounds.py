"""Bounds of how far joints move geoms hold for random chains, at configurations computed by C MuJoCo."""

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vsearch_jax.robot.collision.motion_bounds import extent_from_still_point, lever_arms

# The shapes of the last link. Their surfaces are known in closed form, and are sampled by `_surface`.
SHAPES = {
    "sphere": "0.05",
    "capsule": "0.03 0.1",
    "cylinder": "0.04 0.1",
    "box": "0.05 0.1 0.02",
    "ellipsoid": "0.04 0.1 0.02",
}
NUM_CONFIGURATIONS = 120


class _Joint:
    """A joint of a chain: its kind, its axis, and the shift from the previous joint's anchor to its own, in m."""

    def __init__(self, is_slide: bool, axis: tuple[float, ...], shift: tuple[float, ...], along: float | None) -> None:
        self.is_slide, self.axis, self.shift, self.along = is_slide, np.array(axis), np.array(shift), along


# Whole numbers make axes meet and coincide often.
_vector = st.tuples(*[st.integers(-1, 1)] * 3).filter(any)
_skew = st.tuples(*[st.floats(-1.0, 1.0)] * 3).filter(lambda v: np.linalg.norm(v) > 0.1)
_shift = st.one_of(st.just((0.0, 0.0, 0.0)), st.tuples(*[st.sampled_from([0.0, 0.5, -0.25])] * 3), _skew)
# `along`: the anchor lies on the previous joint's axis, at this distance.
_along = st.one_of(st.none(), st.sampled_from([0.0, 0.5, -0.3]))
_joint = st.builds(_Joint, st.booleans() | st.just(False), _vector | _skew, _shift, _along)


def _build(joints: list[_Joint], shape: str) -> mujoco.MjModel:
    """Returns a chain of one body for each joint, with a geom of the kind `shape` on the last body."""
    spec, previous = mujoco.MjSpec(), None
    body = spec.worldbody
    for joint in joints:
        on_axis = None if previous is None or joint.along is None else joint.along * previous / np.linalg.norm(previous)
        body = body.add_body(pos=joint.shift if on_axis is None else on_axis, mass=1.0, inertia=[1.0, 1.0, 1.0])
        kind = mujoco.mjtJoint.mjJNT_SLIDE if joint.is_slide else mujoco.mjtJoint.mjJNT_HINGE
        body.add_joint(type=kind, axis=joint.axis, range=[-0.2, 0.4] if joint.is_slide else [-180, 180], limited=True)
        previous = joint.axis
    size = [*map(float, SHAPES[shape].split()), 0.0, 0.0][:3]
    body.add_geom(
        type=getattr(mujoco.mjtGeom, f"mjGEOM_{shape.upper()}"), size=size, pos=[0.05, 0.0, 0.1], euler=[20, 30, 0]
    )
    return spec.compile()


def _surface(model: mujoco.MjModel) -> np.ndarray:
    """Returns f64[N, 3] m, points of the geom's surface in its frame: its support points in many directions."""
    kind, (a, b, c) = model.geom_type[0], model.geom_size[0]
    directions = np.random.default_rng(0).normal(size=(200, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    if kind == mujoco.mjtGeom.mjGEOM_SPHERE:
        return a * directions
    if kind == mujoco.mjtGeom.mjGEOM_BOX:
        return np.sign(directions) * [a, b, c]
    if kind == mujoco.mjtGeom.mjGEOM_ELLIPSOID:
        return directions * [a, b, c]
    ends = np.outer(np.sign(directions[:, 2]), [0.0, 0.0, b])
    if kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
        return ends + a * directions
    radial = directions[:, :2] / np.linalg.norm(directions[:, :2], axis=1, keepdims=True)
    return ends + a * np.pad(radial, ((0, 0), (0, 1)))


def _check_bounds(model: mujoco.MjModel) -> None:
    """Compares the bounds of the model's only geom with its positions at random configurations."""
    data, at_qpos0 = mujoco.MjData(model), mujoco.MjData(model)
    mujoco.mj_kinematics(model, at_qpos0)
    levers = lever_arms(model, at_qpos0, tuple(range(model.njnt)))[0]
    point, extent = extent_from_still_point(model, at_qpos0, 0)
    surface, random = _surface(model), np.random.default_rng(1)
    is_hinge = model.jnt_type == mujoco.mjtJoint.mjJNT_HINGE
    for _ in range(NUM_CONFIGURATIONS):
        # Ends of the ranges and quarter turns reach the extremes of chains with right angles.
        quarters = random.choice([-1.0, -0.5, 0.0, 0.5, 1.0], model.nq)
        share = np.where(random.random(model.nq) < 0.5, 0.5 + 0.5 * quarters, random.random(model.nq))
        data.qpos[:] = model.jnt_range[:, 0] + share * (model.jnt_range[:, 1] - model.jnt_range[:, 0])
        mujoco.mj_kinematics(model, data)
        points = data.geom_xpos[0] + surface @ data.geom_xmat[0].reshape(3, 3).T
        assert np.linalg.norm(points - point, axis=1).max() <= extent + 1e-9
        for joint in range(model.njnt):
            speed = np.linalg.norm(np.cross(data.xaxis[joint], points - data.xanchor[joint]), axis=1).max()
            assert (speed if is_hinge[joint] else 1.0) <= levers[joint] + 1e-9


@settings(max_examples=40)
@given(joints=st.lists(_joint, min_size=1, max_size=5), shape=st.sampled_from(sorted(SHAPES)))
def test_bounds_hold_for_random_chains(joints, shape):
    _check_bounds(_build(joints, shape))


@pytest.mark.parametrize("shape", sorted(SHAPES))
def test_a_hinge_that_turns_the_axis_below_it_moves_the_points_of_that_axis(shape):
    first, second = _Joint(False, (0, 0, 1), (0, 0, 0), None), _Joint(False, (1, 0, 0), (0, 0, 0), None)
    _check_bounds(_build([first, second, _Joint(False, (0, 1, 0), (0, 0, 0), 0.5)], shape))


def test_the_centre_of_a_spherical_shoulder_is_still():
    model = _build([_Joint(False, axis, (0, 0, 0), None) for axis in ((0, 0, 1), (0, 1, 0), (1, 0, 0))], "sphere")
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    assert extent_from_still_point(model, data, 0)[1] == pytest.approx(np.hypot(0.05, 0.1) + 0.05)
