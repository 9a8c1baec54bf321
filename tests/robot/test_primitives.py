"""Distances of points and segments from solids equal those of C MuJoCo and of sampled points."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from vsearch_jax.robot.collision import primitives

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
        lambda c, h, s: primitives.min_along_segment(lambda point: primitives.ellipsoid_distance(point, s), c, h),
    ),
}
_PROBE_RADIUS = 1e-4
_segment_distance = jax.jit(primitives.segment_distance)


@pytest.fixture(scope="module", params=list(_SOLIDS))
def solid(request):
    kind, distance = _SOLIDS[request.param]
    return kind, jax.jit(lambda c, h, s: distance(*(tuple(x[:, None]) for x in (c, h, s)))[0])


@given(point=_point, size=_size)
@example(point=jnp.asarray([0.1875, 0.0, 0.1875]), size=jnp.asarray([0.25, 0.125, 0.25]))
@example(point=jnp.asarray([0.171875, 0.0, 0.203125]), size=jnp.asarray([0.28125, 0.03125, 0.25]))
def test_distance_of_a_point_from_a_solid_equals_mujoco(solid, point, size):
    kind, distance = solid
    spec = mujoco.MjSpec()
    spec.worldbody.add_geom(type=kind, size=np.asarray(size, float))
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[_PROBE_RADIUS, 0, 0], pos=np.asarray(point, float))
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    theirs = mujoco.mj_geomDistance(model, data, 0, 1, 10.0, None) + _PROBE_RADIUS
    ours = float(distance(point, jnp.zeros(3), size))
    if theirs > _PROBE_RADIUS:
        assert ours == pytest.approx(theirs, abs=2e-4)
    else:  # MuJoCo only estimates the depth of a penetration.
        assert ours < 2 * _PROBE_RADIUS


@pytest.mark.parametrize("solid", ["box", "cylinder"], indirect=True)
@given(center=_point, half_axis=_point, size=_size)
def test_distance_of_a_segment_from_a_solid_is_the_minimum_over_its_points(solid, center, half_axis, size):
    kind, distance = solid
    middle, half = np.asarray(center, float), np.asarray(half_axis, float)
    points = middle + np.linspace(-1, 1, 20_001)[:, None] * half
    outside = np.abs(points) - np.asarray(size)
    if kind == mujoco.mjtGeom.mjGEOM_CYLINDER:
        outside = np.stack([np.hypot(*points.T[:2]) - float(size[0]), np.abs(points[:, 2]) - float(size[1])], axis=1)
    sampled = np.linalg.norm(np.maximum(outside, 0.0), axis=1).min()
    spacing = 0.5e-4 * np.linalg.norm(half)
    # The cylinder's distance is a lower bound. Segments are up to 1.7 m long here.
    underestimate = 3e-4 if kind == mujoco.mjtGeom.mjGEOM_CYLINDER else 2e-6
    assert sampled - spacing - underestimate <= float(distance(center, half_axis, size)) <= sampled + 2e-6


@given(a=_point, u=_point, b=_point, v=_point)
def test_distance_of_two_segments_is_the_minimum_over_their_points(a, u, b, v):
    ours = float(_segment_distance(a, u, b, v))
    s = np.linspace(-1, 1, 101)[:, None, None]
    t = np.linspace(-1, 1, 101)[None, :, None]
    sampled = np.linalg.norm((np.asarray(a) + s * np.asarray(u)) - (np.asarray(b) + t * np.asarray(v)), axis=-1).min()
    spacing = 0.01 * (np.linalg.norm(u) + np.linalg.norm(v))
    assert sampled - spacing - 1e-4 <= ours <= sampled + 1e-4
