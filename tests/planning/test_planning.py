"""Edges, trees, shortcuts and timing, against C MuJoCo and against what a path must be."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from oracles.planning import Oracle, free_joints
from samples.second_arm import MJCF
from vsearch_jax.config import ConfigError, PlanningConfig, SceneConfig
from vsearch_jax.planning import PlanningError, edge_is_free, rrt, rrt_connect, sample, start_limits, time_path
from vsearch_jax.planning.edges import advance, edge_between
from vsearch_jax.planning.proofs import is_free_between, look, motion_bounds, ways
from vsearch_jax.robot import collision
from vsearch_jax.robot.arm import build_arm, clearance, forward_kinematics
from vsearch_jax.scene import SceneError, build_scene
from vsearch_jax.types import Path, PlanStatus

CONFIG = PlanningConfig()
NUM_PROBLEMS = 64


class _Problems:
    """Random free starts and goals among posts, and what RRT-Connect makes of them."""

    def __init__(self, count: int, seed: int) -> None:
        self.scene = build_scene(SceneConfig(obstacles="posts"))
        self.arm = build_arm(self.scene)
        self.oracle = Oracle(self.scene)
        lower, upper = start_limits(self.arm)
        joints = free_joints(self.scene, lower, upper, seed, 2 * count)
        self.start, self.goal = joints[:count], joints[count:]
        self.goal[:, 7:] = self.start[:, 7:]
        good = [self.oracle.is_free(q) for q in self.goal]  # with the other fingers
        self.start, self.goal = self.start[good], self.goal[good]
        self.keys = jax.random.split(jax.random.key(seed), len(self.start))

        self.plan = jax.jit(jax.vmap(lambda k, a, b: rrt_connect(self.arm, k, a, b, CONFIG)))

    @functools.cached_property
    def paths(self):
        return self.plan_motion(self.keys, self.start, self.goal)

    @functools.cached_property
    def found(self):
        return np.asarray(self.paths.status) == PlanStatus.FOUND


@pytest.fixture(scope="module")
def problems() -> _Problems:
    return _Problems(NUM_PROBLEMS, 0)


def _check_paths(problems: _Problems) -> None:
    waypoints = np.asarray(problems.paths.waypoints)
    for index in np.flatnonzero(problems.found):
        path = waypoints[index]
        np.testing.assert_allclose(path[0], problems.start[index], atol=1e-6)
        np.testing.assert_allclose(path[-1], problems.goal[index], atol=1e-4)
        assert problems.oracle.blocked(path) == 0, index
        length = np.linalg.norm(np.diff(path, axis=0), axis=1).sum()
        assert float(problems.paths.length[index]) == pytest.approx(length, rel=1e-4)


def test_paths_are_free_and_join_start_and_goal(problems):
    assert problems.found.mean() >= 0.95
    assert (np.asarray(problems.paths.length) > 1.05 * np.linalg.norm(problems.goal - problems.start, axis=1)).any()
    _check_paths(problems)


@pytest.mark.slow
def test_a_uniform_tree_finds_free_paths_too_and_tells_a_spent_budget(problems):
    config = dataclasses.replace(CONFIG, max_iterations=64)
    paths = jax.jit(jax.vmap(lambda k, a, b: rrt(problems.arm, k, a, b, config)))(
        problems.keys, problems.start, problems.goal
    )
    found = np.asarray(paths.status) == PlanStatus.FOUND
    assert found.mean() >= 0.6
    assert np.all(np.asarray(paths.status)[~found] == PlanStatus.EXHAUSTED) and not np.all(found)
    assert np.all(np.isinf(np.asarray(paths.length)[~found]))
    assert sum(problems.oracle.blocked(path) for path in np.asarray(paths.waypoints)[found]) == 0


def test_free_edges_are_free_and_most_blocked_ones_touch(problems):
    check = jax.jit(jax.vmap(lambda a, b: edge_is_free(problems.arm, a, b, CONFIG)))
    is_free = np.asarray(check(problems.start, problems.goal))
    assert 0.1 < is_free.mean() < 0.9
    touching = np.array(
        [problems.oracle.blocked(np.stack(ends)) > 0 for ends in zip(problems.start, problems.goal, strict=True)]
    )
    assert not np.any(is_free & touching)
    assert touching[~is_free].mean() > 0.8


def test_levers_bound_how_fast_distances_change(problems):
    random, arm = np.random.default_rng(1), problems.arm
    step = random.normal(size=problems.start.shape).astype(np.float32) * 0.05
    step[:, 7:] = 0.0
    gaps = jax.jit(jax.vmap(lambda q: look(arm, q).gap))
    change = np.abs(np.asarray(gaps(problems.start + step)) - np.asarray(gaps(problems.start)))
    bound = np.abs(step[:, :7]) @ np.asarray(arm.planning_pairs.levers).T
    assert (change - bound).max() < 1e-4  # what a distance from a cylinder may be short of
    assert (change / np.maximum(bound, 1e-6)).max() > 0.5


def _ends(axes) -> np.ndarray:
    """Both ends of the capsules, [2, configurations, capsules, 3] m."""
    center, half_axis = (np.stack(vector, axis=-1) for vector in axes)
    return np.stack([center - half_axis, center + half_axis])


@pytest.fixture(scope="module", params=["lwr", "second"])
def any_arm(request, problems, tmp_path_factory):
    """The LWR, and an arm with a slide and a branch beside the camera."""
    if request.param == "lwr":
        return problems.arm
    path = tmp_path_factory.mktemp("arm") / "second.xml"
    path.write_text(MJCF.replace('axis="0 1 1"/>', 'axis="0 1 1" range="-2 2"/>'))
    return build_arm(build_scene(SceneConfig(arm=str(path))))


def test_bends_bound_the_second_derivatives_along_an_edge(any_arm):
    arm, places = any_arm, np.linspace(0.0, 1.0, 33, dtype=np.float32)
    random, address = np.random.default_rng(3), np.asarray(any_arm.chain.address)
    axes_along = jax.jit(jax.vmap(lambda q: look(arm, q).axes))
    largest = 0.0
    for _ in range(8):
        start, goal = (np.array(arm.home) for _ in range(2))
        for qpos in (start, goal):
            qpos[address] = random.uniform(*(limit[address] for limit in start_limits(arm)))
        change = goal - start
        ends = _ends(axes_along((start + places[:, None] * change).astype(np.float32)))
        second = np.linalg.norm(ends[:, 2:] - 2.0 * ends[:, 1:-1] + ends[:, :-2], axis=-1).max(axis=(0, 1)) * 32.0**2
        bend = np.asarray(motion_bounds(arm.planning_pairs, jnp.asarray(change[address], jnp.float32)).bend)
        assert np.all(second <= bend + 2e-3)  # of float32, magnified by 32^2
        largest = max(largest, (second / np.maximum(bend, 1e-3)).max())
    assert largest > 0.1


@pytest.mark.parametrize("part", [collision.TABLE, collision.OBSTACLE])
def test_nothing_touches_between_samples_that_prove_it(problems, part):
    arm, pairs = problems.arm, problems.arm.planning_pairs
    random = np.random.default_rng(2)
    starts = np.repeat(problems.start, 32, axis=0)
    places = np.linspace(0.0, 1.0, 32, dtype=np.float32)
    change = random.normal(size=(len(starts), 7)).astype(np.float32)
    change /= np.linalg.norm(change, axis=1, keepdims=True)
    steps = random.uniform(0.02, 1.5, len(starts)).astype(np.float32)

    def of_part(sample):
        return sample._replace(gap=jnp.where(pairs.part == part, sample.gap, 1e3))

    def check(start, change, step):
        way_there = jnp.zeros_like(start).at[:7].set(step * change)
        ends = of_part(look(arm, start)), of_part(look(arm, start + way_there))
        bounds = motion_bounds(pairs, change)
        is_proven = is_free_between(pairs, ends, step, bounds, ways(ends[0].axes, ends[1].axes)[0])
        by_levers = jnp.all(ends[0].gap + ends[1].gap >= bounds.rate * step)
        between = jax.vmap(lambda place: jnp.min(of_part(look(arm, start + place * way_there)).gap))(places)
        is_proven = is_proven & (jnp.minimum(between[0], between[-1]) > 0.0)
        return is_proven, by_levers, jnp.min(between)

    is_proven, by_levers, nearest = map(np.asarray, jax.jit(jax.vmap(check))(starts, change, steps))
    assert nearest[is_proven].min() > 0.0
    assert 0.05 < is_proven.mean() < 0.95
    assert is_proven.sum() > 1.3 * by_levers.sum()  # what the chords add


def test_an_arm_that_almost_touches_gets_away(problems):
    """From a tenth of the resolution off, straight back to where it came from, but no nearer to what is there."""
    arm, look_there = problems.arm, jax.jit(lambda q: jnp.min(look(problems.arm, q).gap))
    is_free = jax.jit(lambda a, b: edge_is_free(arm, a, b, CONFIG))
    count = 0
    for start, goal in zip(problems.start, problems.goal, strict=True):
        places = np.linspace(0.0, 1.0, 200, dtype=np.float32)
        gaps = np.array([look_there(start + place * (goal - start)) for place in places])
        if gaps.min() > 0.0 or gaps[0] < 0.01 or np.any(np.diff(gaps[: np.argmax(gaps <= 0.0) + 1]) > 0.0):
            continue
        low, high = places[np.argmax(gaps <= 0.0) - 1], places[np.argmax(gaps <= 0.0)]
        for _ in range(40):
            middle = (low + high) / 2
            low, high = (low, middle) if look_there(start + middle * (goal - start)) < 2e-4 else (middle, high)
        near = start + low * (goal - start)
        assert 1e-4 < look_there(near) < CONFIG.resolution / 10
        assert is_free(near, start)
        assert not is_free(near, goal)
        count += 1
    assert count >= 3


def test_what_is_not_finite_spoils_no_other_edge(problems):
    check = jax.jit(jax.vmap(lambda a, b: edge_is_free(problems.arm, a, b, CONFIG)))
    goal = problems.goal.copy()
    expected = np.asarray(check(problems.start, goal))
    free = np.flatnonzero(expected)
    for index, value in zip(free, (np.inf, -np.inf, np.nan), strict=False):
        goal[index, 2] = value
    is_free = np.asarray(check(problems.start, goal))
    assert not is_free[free[:3]].any()
    np.testing.assert_array_equal(np.delete(is_free, free[:3]), np.delete(expected, free[:3]))


def test_a_resolution_that_float32_cannot_resolve_is_refused():
    with pytest.raises(ConfigError, match="resolution is 1e-08; allowed"):
        PlanningConfig(resolution=1e-8)


def test_an_edge_advances_alone_as_it_does_in_a_batch(problems):
    arm = problems.arm
    starts, goals, rest = problems.start[:6, :7], problems.goal[:6, :7], problems.start[:6]

    def go_on(start, goal, qpos):
        edge = advance(arm, edge_between(arm, start, goal), qpos, CONFIG, 12)
        return edge.done, edge.num_probes, edge.is_blocked, edge.sample.gap

    together = jax.jit(jax.vmap(go_on))(starts, goals, rest)
    in_pairs = jax.jit(jax.vmap(jax.vmap(go_on)))(*(x.reshape(3, 2, -1) for x in (starts, goals, rest)))
    alone = jax.jit(lambda *xs: jax.lax.map(lambda x: go_on(*x), xs))(starts, goals, rest)
    for ours, theirs, nested in zip(together, alone, in_pairs, strict=True):
        np.testing.assert_allclose(ours, theirs, atol=1e-4)
        np.testing.assert_allclose(nested.reshape(ours.shape), theirs, atol=1e-4)
    assert np.any(np.asarray(together[0]) > 0.0) and np.any(together[2])


def test_planning_pairs_never_claim_more_room_than_there_is(problems):
    def both(qpos):
        data = forward_kinematics(problems.arm, qpos)
        exact = clearance(problems.arm, data)
        gap = look(problems.arm, qpos).gap
        parts = (collision.OBJECT, collision.SELF, collision.OBSTACLE)
        return jnp.stack([collision.min_distance(problems.arm.planning_pairs, gap, part) for part in parts]), exact

    ours, exact = jax.jit(jax.vmap(both))(problems.start)
    for column, part in enumerate(("object", "self", "obstacles")):
        near = np.asarray(getattr(exact, part)) < collision.NEVER_NEAR
        assert np.all(np.asarray(ours)[near, column] <= np.asarray(getattr(exact, part))[near] + 1e-5)


def test_bad_ends_have_a_status(problems):
    start, goal = problems.start[0], problems.goal[0]
    random = np.random.default_rng(0).uniform(*start_limits(problems.arm), (200, 9)).astype(np.float32)
    folded = next(qpos for qpos in random if problems.oracle.look(qpos).ncon > 0)
    outside = goal.copy()
    outside[1] = 2.5
    nan = np.where(np.arange(9) == 3, np.nan, start).astype(np.float32)
    cases = [(folded, goal), (start, folded), (start, outside), (nan, goal), (start, nan), (outside, goal)]
    starts, goals = problems.start.copy(), problems.goal.copy()  # as many as ever, which is compiled already
    starts[:6], goals[:6] = (np.stack(ends) for ends in zip(*cases, strict=True))
    paths = jax.tree.map(lambda leaf: leaf[:6], problems.plan(problems.keys, starts, goals))
    blocked = [PlanStatus.START_BLOCKED if i in (0, 3, 5) else PlanStatus.GOAL_BLOCKED for i in range(6)]
    np.testing.assert_array_equal(paths.status, blocked)
    assert np.all(np.isinf(paths.length)) and np.all(np.isfinite(paths.waypoints))


def _times(problems: _Problems, count: int = 400):
    def timed(path):
        trajectory = time_path(problems.arm, path, CONFIG)
        times = jnp.linspace(0.0, 1.0, count) * trajectory.times[-1]
        joints, velocity = jax.vmap(lambda t: sample(problems.arm, trajectory, t))(times)
        return times, joints, velocity, trajectory

    return jax.jit(jax.vmap(timed))(problems.paths)


def _check_motions(problems: _Problems) -> None:
    times, joints, velocity, trajectory = (jax.tree.map(np.asarray, part) for part in _times(problems))
    speed = np.asarray(problems.arm.speed)[:7]
    acceleration = speed / CONFIG.acceleration_time
    for i in np.flatnonzero(problems.found):
        step = times[i, 1]
        assert np.all(np.abs(velocity[i, :, :7]) <= speed * 1.001)
        # Between samples the mean acceleration; float32 leaves some noise in a difference of velocities.
        change = np.diff(velocity[i, :, :7], axis=0) / step
        assert np.all(np.abs(change) <= acceleration * 1.02 + 1e-3 / step), i
        np.testing.assert_allclose(velocity[i, 0], 0.0, atol=1e-3)
        np.testing.assert_allclose(joints[i, 0], problems.start[i], atol=1e-5)
        np.testing.assert_allclose(joints[i, -1], problems.goal[i], atol=1e-4)
        mean = 0.5 * (velocity[i, 1:] + velocity[i, :-1]) * step
        slack = 0.25 * acceleration.max() * step**2 + 2e-5  # where the acceleration jumps between two samples
        np.testing.assert_allclose(np.diff(joints[i], axis=0), mean, atol=slack)
        assert all(problems.oracle.is_free(q) for q in joints[i]), i
    assert np.all(np.isfinite(trajectory.times))


def test_motions_keep_the_limits_and_stay_free(problems):
    _check_motions(problems)


def test_a_straight_motion_is_as_fast_as_its_slowest_joint(problems):
    path = jax.tree.map(lambda leaf: leaf[0], problems.paths)
    goal = problems.start[0].copy()
    goal[0] += 1.0
    waypoints = jnp.concatenate([problems.start[:1], jnp.repeat(goal[None], CONFIG.max_waypoints - 1, axis=0)])
    trajectory = jax.jit(lambda p: time_path(problems.arm, p, CONFIG))(path.replace(waypoints=waypoints))
    speed = float(problems.arm.speed[0])
    assert float(trajectory.times[-1]) == pytest.approx(1.0 / speed + CONFIG.acceleration_time, rel=0.03)


def test_missing_limits_are_named(tmp_path):
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


def test_obstacles_keep_their_distance_as_mujoco_measures_it(problems):
    exact = jax.jit(jax.vmap(lambda q: clearance(problems.arm, forward_kinematics(problems.arm, q)).obstacles))(
        problems.start
    )
    for index, qpos in enumerate(problems.start[:16]):
        data = problems.oracle.look(qpos)
        theirs = min(
            mujoco.mj_geomDistance(problems.scene.mj_model, data, a, b, 10.0, None)
            for a in problems.oracle.moving
            for b in problems.scene.obstacle_geom_ids
        )
        assert float(exact[index]) == pytest.approx(theirs, abs=2e-4)


@pytest.mark.slow
def test_a_thousand_paths_are_free_and_keep_the_limits():
    problems = _Problems(1100, 7)
    assert problems.found.sum() >= 1000
    _check_paths(problems)
    _check_motions(problems)
