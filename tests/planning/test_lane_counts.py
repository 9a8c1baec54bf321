"""The numbers of problems that planning solves at once."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vsearch_jax.config import IKConfig, SceneConfig
from vsearch_jax.planning import ik, lane_counts, reachability
from vsearch_jax.planning.rrt import _repeat_for_lanes
from vsearch_jax.robot.arm import build_arm, camera_pose, forward_kinematics
from vsearch_jax.scene import build_scene


def test_counts_follow_the_platform(monkeypatch):
    assert lane_counts.current() == lane_counts.LaneCounts(ik=256, rrt=64, azimuths=12)
    assert reachability._azimuths_at_once(72) == 12
    assert reachability._azimuths_at_once(20) == 4
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert lane_counts.current() == lane_counts.ACCELERATOR
    assert reachability._azimuths_at_once(72) == 72


def test_an_override_traces_again_and_ends_with_its_block():
    traced = []

    @jax.jit
    def zeros():
        traced.append(lane_counts.current().rrt)
        return jnp.zeros(lane_counts.current().rrt)

    assert zeros().shape == (64,)
    with lane_counts.override(rrt=8, azimuths=None) as counts:
        assert counts == lane_counts.LaneCounts(ik=256, rrt=8, azimuths=None)
        assert zeros().shape == (8,)
        with lane_counts.override(rrt=4):
            assert zeros().shape == (4,)
            assert lane_counts.current().azimuths is None
        assert zeros().shape == (8,)
    assert zeros().shape == (64,)
    assert traced == [64, 8, 4, 8, 64]


@pytest.mark.parametrize("counts", [{"rrt": 0}, {"ik": None}, {"ik": 2.5}, {"lanes": 8}])
def test_a_bad_override_is_refused(counts):
    name, value = next(iter(counts.items()))
    with pytest.raises(ValueError, match=f"{name} is {value}; allowed are ik, rrt, azimuths"):
        lane_counts.override(**counts).__enter__()
    assert lane_counts.current() == lane_counts.CPU


def test_planners_have_at_most_one_lane_for_each_problem():
    state = jnp.zeros(2)
    assert _repeat_for_lanes(state, 5).shape == (5, 2)
    assert _repeat_for_lanes(state, 1000).shape == (64, 2)
    with lane_counts.override(rrt=500):
        assert _repeat_for_lanes(state, 1000).shape == (500, 2)


@pytest.mark.slow
def test_the_number_of_lanes_does_not_change_solutions():
    arm, config = build_arm(build_scene(SceneConfig())), IKConfig(num_seeds=4)
    joints = np.random.default_rng(0).uniform(arm.lower, arm.upper, (8, 9)).astype(np.float32)
    poses = jax.jit(jax.vmap(lambda q: camera_pose(arm, forward_kinematics(arm, q))))(joints)
    solve = jax.jit(jax.vmap(lambda pose, q: ik(arm, pose, q, config)))
    expected = solve(poses, joints[::-1])
    with lane_counts.override(ik=3):
        result = solve(poses, joints[::-1])
    assert np.asarray(expected.is_converged).mean() > 0.5
    np.testing.assert_array_equal(result.status, expected.status)
    np.testing.assert_allclose(result.qpos, expected.qpos, atol=1e-3)
