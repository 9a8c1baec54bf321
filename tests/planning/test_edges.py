"""Edges and the proofs behind them, compared with C MuJoCo and with dense samples."""

import itertools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from samples.planning_problems import CONFIG, PlanningProblems
from samples.second_arm import MJCF
from vsearch_jax.config import ConfigError, PlanningConfig, SceneConfig
from vsearch_jax.planning import edge_is_free, start_limits
from vsearch_jax.planning.edges import check_edge, edge_between
from vsearch_jax.planning.proofs import displacements, edge_bounds, evaluate_sample, is_free_between
from vsearch_jax.robot import collision
from vsearch_jax.robot.arm import build_arm, clearance, forward_kinematics
from vsearch_jax.scene import build_scene


@pytest.fixture(scope="module")
def problems() -> PlanningProblems:
    return PlanningProblems(64, 0)


def test_free_edges_are_free_and_most_blocked_ones_touch(problems):
    check = jax.jit(jax.vmap(lambda a, b: edge_is_free(problems.arm, a, b, CONFIG)))
    is_free = np.asarray(check(problems.start, problems.goal))
    assert 0.1 < is_free.mean() < 0.9
    touching = np.array(
        [problems.oracle.count_blocked(np.stack(ends)) > 0 for ends in zip(problems.start, problems.goal, strict=True)]
    )
    assert not np.any(is_free & touching)
    assert touching[~is_free].mean() > 0.8


def test_levers_bound_the_change_of_distances(problems):
    random, arm = np.random.default_rng(1), problems.arm
    step = random.normal(size=problems.start.shape).astype(np.float32) * 0.05
    step[:, 7:] = 0.0
    gaps = jax.jit(jax.vmap(lambda q: evaluate_sample(arm, q).gap))
    change = np.abs(np.asarray(gaps(problems.start + step)) - np.asarray(gaps(problems.start)))
    bound = np.abs(step[:, :7]) @ np.asarray(arm.planning_pairs.levers).T
    assert (change - bound).max() < 1e-4  # the error of a distance from a cylinder
    assert (change / np.maximum(bound, 1e-6)).max() > 0.5


def _capsule_ends(axes) -> np.ndarray:
    """Both ends of the capsules, [2, configurations, capsules, 3] m."""
    center, half_axis = (np.stack(vector, axis=-1) for vector in axes)
    return np.stack([center - half_axis, center + half_axis])


def _body_corners(arm, frames) -> np.ndarray:
    """The corners of the bodies' bounding boxes, [8, configurations, bodies, 3] m."""
    position = np.stack(frames.position, axis=-1)
    rotation = np.stack([np.stack(row, axis=-1) for row in frames.rotation], axis=-2)
    center, size = np.asarray(arm.planning_pairs.bodies.box_center), np.asarray(arm.planning_pairs.bodies.box_size)
    signs = np.array(list(itertools.product((-1.0, 1.0), repeat=3)))
    corners = center + signs[:, None] * size
    return position + np.einsum("nbij,cbj->cnbi", rotation, corners)


def _largest_second_differences(points: np.ndarray) -> np.ndarray:
    second = np.linalg.norm(points[:, 2:] - 2.0 * points[:, 1:-1] + points[:, :-2], axis=-1)
    return second.max(axis=(0, 1), initial=0.0)


@pytest.fixture(scope="module", params=["lwr", "second"])
def any_arm(request, problems, tmp_path_factory):
    """The LWR, and an arm with a slide and a side branch."""
    if request.param == "lwr":
        return problems.arm
    path = tmp_path_factory.mktemp("arm") / "second.xml"
    path.write_text(MJCF.replace('axis="0 1 1"/>', 'axis="0 1 1" range="-2 2"/>'))
    return build_arm(build_scene(SceneConfig(arm=str(path))))


def test_bends_bound_the_second_derivatives_along_an_edge(any_arm):
    arm, places = any_arm, np.linspace(0.0, 1.0, 33, dtype=np.float32)
    random, address = np.random.default_rng(3), np.asarray(any_arm.chain.address)
    samples_along = jax.jit(jax.vmap(lambda q: evaluate_sample(arm, q)))
    largest = 0.0
    for _ in range(8):
        start, goal = (np.array(arm.home) for _ in range(2))
        for qpos in (start, goal):
            qpos[address] = random.uniform(*(limit[address] for limit in start_limits(arm)))
        change = goal - start
        samples = samples_along((start + places[:, None] * change).astype(np.float32))
        points = (_capsule_ends(samples.axes), _body_corners(arm, samples.frames))
        second = np.concatenate([_largest_second_differences(p) for p in points]) * 32.0**2
        bend = np.asarray(edge_bounds(arm.planning_pairs, jnp.asarray(change[address], jnp.float32)).bend)
        assert np.all(second <= bend + 2e-3)  # rounding in float32, magnified by 32^2
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
        motion = jnp.zeros_like(start).at[:7].set(step * change)
        ends = of_part(evaluate_sample(arm, start)), of_part(evaluate_sample(arm, start + motion))
        bounds = edge_bounds(pairs, change)
        is_proven = is_free_between(pairs, ends, step, bounds, displacements(pairs, *ends)[0])
        by_levers = jnp.all(ends[0].gap + ends[1].gap >= bounds.rate * step)
        between = jax.vmap(lambda place: jnp.min(of_part(evaluate_sample(arm, start + place * motion)).gap))(places)
        is_proven = is_proven & (jnp.minimum(between[0], between[-1]) > 0.0)
        return is_proven, by_levers, jnp.min(between)

    is_proven, by_levers, nearest = map(np.asarray, jax.jit(jax.vmap(check))(starts, change, steps))
    assert nearest[is_proven].min() > 0.0
    assert 0.05 < is_proven.mean() < 0.95
    assert is_proven.sum() > 1.3 * by_levers.sum()  # the chords prove more than the levers alone


def _place_before_contact(distance_at, is_close) -> float | None:
    """Share of an edge, before its first contact, at which `is_close` of the distance is first true.

    None if the edge has no contact, starts close to something, or does not come steadily nearer to the contact.
    """
    places = np.linspace(0.0, 1.0, 200, dtype=np.float32)
    gaps = np.array([distance_at(place) for place in places])
    contact = np.argmax(gaps <= 0.0)
    if gaps.min() > 0.0 or gaps[0] < 0.01 or np.any(np.diff(gaps[: contact + 1]) > 0.0):
        return None
    low, high = places[contact - 1], places[contact]
    for _ in range(40):
        middle = (low + high) / 2
        low, high = (low, middle) if is_close(distance_at(middle)) else (middle, high)
    return low


def test_an_arm_close_to_contact_can_leave_but_not_come_nearer(problems):
    arm = problems.arm
    distance = jax.jit(lambda q: jnp.min(evaluate_sample(arm, q).gap))
    is_free = jax.jit(lambda a, b: edge_is_free(arm, a, b, CONFIG))
    count = 0
    for start, goal in zip(problems.start, problems.goal, strict=True):
        change = goal - start
        place = _place_before_contact(lambda u, a=start, c=change: distance(a + u * c), lambda gap: gap < 2e-4)
        if place is None:
            continue
        near = start + place * change
        assert 1e-4 < distance(near) < CONFIG.resolution / 10
        assert is_free(near, start)
        assert not is_free(near, goal)
        count += 1
    assert count >= 3


def test_an_edge_that_is_not_finite_does_not_change_other_edges(problems):
    check = jax.jit(jax.vmap(lambda a, b: edge_is_free(problems.arm, a, b, CONFIG)))
    goal = problems.goal.copy()
    expected = np.asarray(check(problems.start, goal))
    free = np.flatnonzero(expected)
    for index, value in zip(free, (np.inf, -np.inf, np.nan), strict=False):
        goal[index, 2] = value
    is_free = np.asarray(check(problems.start, goal))
    assert not is_free[free[:3]].any()
    np.testing.assert_array_equal(np.delete(is_free, free[:3]), np.delete(expected, free[:3]))


def test_a_resolution_below_float32_is_refused():
    with pytest.raises(ConfigError, match="resolution is 1e-08; allowed"):
        PlanningConfig(resolution=1e-8)


def test_an_edge_is_checked_alone_as_in_a_batch(problems):
    arm = problems.arm
    starts, goals, rest = problems.start[:6, :7], problems.goal[:6, :7], problems.start[:6]

    def check(start, goal, qpos):
        edge = check_edge(arm, edge_between(arm, start, goal), qpos, CONFIG, 12)
        return edge.proven, edge.num_probes, edge.is_blocked, edge.sample.gap

    together = jax.jit(jax.vmap(check))(starts, goals, rest)
    in_pairs = jax.jit(jax.vmap(jax.vmap(check)))(*(x.reshape(3, 2, -1) for x in (starts, goals, rest)))
    alone = jax.jit(lambda *xs: jax.lax.map(lambda x: check(*x), xs))(starts, goals, rest)
    for ours, theirs, nested in zip(together, alone, in_pairs, strict=True):
        np.testing.assert_allclose(ours, theirs, atol=1e-4)
        np.testing.assert_allclose(nested.reshape(ours.shape), theirs, atol=1e-4)
    assert np.any(np.asarray(together[0]) > 0.0) and np.any(together[2])


def test_planning_distances_are_lower_bounds(problems):
    def both(qpos):
        data = forward_kinematics(problems.arm, qpos)
        exact = clearance(problems.arm, data)
        gap = evaluate_sample(problems.arm, qpos).gap
        parts = (collision.OBJECT, collision.SELF, collision.OBSTACLE)
        return jnp.stack([collision.min_distance(problems.arm.planning_pairs, gap, part) for part in parts]), exact

    ours, exact = jax.jit(jax.vmap(both))(problems.start)
    for column, part in enumerate(("object", "self", "obstacles")):
        near = np.asarray(getattr(exact, part)) < collision.NEVER_NEAR
        assert np.all(np.asarray(ours)[near, column] <= np.asarray(getattr(exact, part))[near] + 1e-5)


def test_distances_from_obstacles_equal_those_of_mujoco(problems):
    exact = jax.jit(jax.vmap(lambda q: clearance(problems.arm, forward_kinematics(problems.arm, q)).obstacles))(
        problems.start
    )
    for index, qpos in enumerate(problems.start[:16]):
        data = problems.oracle.compute_contacts(qpos)
        theirs = min(
            mujoco.mj_geomDistance(problems.scene.mj_model, data, a, b, 10.0, None)
            for a in problems.oracle.moving
            for b in problems.scene.obstacle_geom_ids
        )
        assert float(exact[index]) == pytest.approx(theirs, abs=2e-4)
