"""Inverse kinematics by Levenberg-Marquardt inside the joint limits, from several starts."""

from __future__ import annotations

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxlie import SE3

from vsearch_jax.config import IKConfig
from vsearch_jax.planning import levenberg
from vsearch_jax.planning.levenberg import Goal, Iterate
from vsearch_jax.planning.starts import finite_joints, judge
from vsearch_jax.robot.arm import Arm, forward_kinematics, is_free
from vsearch_jax.types import IKResult
from vsearch_jax.xla import lane_pool
from vsearch_jax.xla.batching import flatten_vmap
from vsearch_jax.xla.tree import tree_where

# Lanes of a batch: enough for the vector units, few enough for the cache.
MOST_LANES = 256
# How often a solution in contact is put aside for one from later starts.
NUM_RETRIES = 2
# The preference: half the squared way from the present joints, and this much for each joint at its limit, which counts
# from the last tenth of the range on.
LIMIT_WEIGHT, LIMIT_SHARE = 0.05, 0.1
# Share of the preference's slope that a step follows, and its longest step of a joint, in rad or m.
PREFERENCE_RATE, PREFERENCE_STEP = 0.5, 0.25


class _Problem(NamedTuple):
    """A goal, the present joints f32[J] (of the chain, finite) and the first start that is tried, i32[]."""

    goal: Goal
    present: Array
    first_start: Array


class _State(NamedTuple):
    """A lane.

    Attributes:
      iterate: of the present start; once it has converged, where the nullspace has taken it.
      start: i32[], which start it came from.
      iterations: i32[], done from this start.
      polish: i32[], nullspace steps done; -1 before convergence.
      joints: f32[J], the best found so far.
      cost: f32[], their cost; while nothing has converged.
      preference: f32[], their preference; +inf while nothing has converged.
      is_done: bool[].
    """

    iterate: Iterate
    start: Array
    iterations: Array
    polish: Array
    joints: Array
    cost: Array
    preference: Array
    is_done: Array


class _Solution(NamedTuple):
    """Joints f32[J], whether they solve the problem, bool[], and the start after the last one used, i32[]."""

    joints: Array
    is_solved: Array
    next_start: Array


def ik(arm: Arm, T_world_camera: SE3, qpos: Array, config: IKConfig) -> IKResult:
    """Returns joints that bring the wrist camera to `T_world_camera`.

    The starts are the present joints, then `config.num_seeds - 1` others spread evenly over the limits. From the first
    that converges the arm's redundancy is used to come near the present joints and away from the limits. A solution in
    contact gives way to one without, if the next starts find one. Without any solution the closest try is returned.
    Joints that do not move the camera (fingers, loose parts) stay.

    Under `vmap` the problems share a fixed number of lanes (see `xla.lane_pool`), so that none waits for the slowest;
    the arm cannot be mapped over.

    Args:
      arm: the arm.
      T_world_camera: the pose wanted, in world.
      qpos: f32[nq] rad or m, the present joints. Values that are not finite are solved for from the middle of the
        limits, but the status says so and the result does not count as converged.
      config: iterations, damping, tolerances, number of starts, and whether the camera may roll.
    """
    solve = flatten_vmap(functools.partial(_solve_batch, config))
    poses = (T_world_camera.translation()[None], T_world_camera.rotation().as_matrix()[None])
    result = solve(arm, (*poses, qpos[None]))
    return jax.tree.map(lambda leaf: leaf[0], result)


def _solve_batch(config: IKConfig, arm: Arm, batch: tuple[Array, Array, Array]) -> IKResult:
    positions, rotations, qpos = batch
    count, address = qpos.shape[0], arm.chain.address
    finite = jax.vmap(functools.partial(finite_joints, arm))(qpos)
    limits = [jnp.broadcast_to(limit[address][None], (count, len(address))) for limit in (arm.lower, arm.upper)]
    goal = Goal(positions, rotations, *limits)
    problems = _Problem(goal, finite[:, address], jnp.zeros(count, jnp.int32))
    blank = _Solution(finite[:, address], jnp.zeros(count, bool), jnp.zeros(count, jnp.int32))

    def attempt(index: Array, state: tuple[_Solution, Array]) -> tuple[_Solution, Array]:
        best, is_clear = state
        is_retry = best.is_solved & ~is_clear & (best.next_start < config.num_seeds)
        is_open = is_retry | (index == 0)
        again = _run(arm, config, problems._replace(first_start=best.next_start), is_open, best)
        is_free = _clear(arm, again.joints, finite, is_open & again.is_solved)
        joints = jnp.where((is_free | (index == 0))[:, None], again.joints, best.joints)
        return _Solution(joints, again.is_solved | best.is_solved, again.next_start), is_clear | is_free

    # One loop for the first attempt and the others: what it holds is compiled once.
    found, _ = jax.lax.fori_loop(0, 1 + NUM_RETRIES, attempt, (blank, jnp.zeros(count, bool)))
    whole = finite.at[:, address].set(found.joints)
    data = jax.vmap(functools.partial(forward_kinematics, arm))(whole)
    return jax.vmap(functools.partial(judge, arm, config))(goal, data, qpos)


def _clear(arm: Arm, joints: Array, finite: Array, is_open: Array) -> Array:
    """Returns bool[N]: without contact with the chain at `joints` (f32[N, J]); false where not `is_open`."""

    def step(problem: tuple[Array, Array], _: Array) -> Array:
        chain, whole = problem
        free = is_free(arm, forward_kinematics(arm, whole.at[arm.chain.address].set(chain)))
        return jnp.where(free, 1, 0)

    job = lane_pool.Job(
        reset=lambda _, state, is_new: jnp.where(is_new, -1, state),
        step=step,
        is_done=lambda state: state >= 0,
        result=lambda _, state: state > 0,
        has_stragglers=False,
    )
    blank, states = jnp.zeros(is_open.shape, bool), jnp.zeros(min(MOST_LANES, is_open.shape[0]), jnp.int32)
    return lane_pool.run(job, (joints, finite), lane_pool.queue_where(is_open), states, blank)


def _run(arm: Arm, config: IKConfig, problems: _Problem, is_open: Array, results: _Solution) -> _Solution:
    job = lane_pool.Job(
        functools.partial(_begin, config),
        functools.partial(_step, arm, config),
        lambda state: state.is_done,
        lambda _, state: _Solution(state.joints, jnp.isfinite(state.preference), state.start + 1),
    )
    num_lanes = min(MOST_LANES, is_open.shape[0])
    first = jax.tree.map(lambda leaf: leaf[:num_lanes], problems)
    states = jax.vmap(functools.partial(_fresh, config))(first)
    return lane_pool.run(job, problems, lane_pool.queue_where(is_open), states, results)


def _fresh(config: IKConfig, problem: _Problem) -> _State:
    start = _start(problem, problem.first_start)
    zero, infinite = jnp.int32(0), jnp.float32(jnp.inf)
    iterate = levenberg.begin(start, config)
    return _State(iterate, problem.first_start, zero, jnp.int32(-1), start, infinite, infinite, jnp.bool_(False))


def _begin(config: IKConfig, problem: _Problem, state: _State, is_new: Array) -> _State:
    return tree_where(is_new, _fresh(config, problem), state)


def _step(arm: Arm, config: IKConfig, problem: _Problem, state: _State) -> _State:
    """One evaluation of the kinematics: of Levenberg-Marquardt before convergence, along the nullspace after it."""
    goal, is_polishing = problem.goal, state.polish >= 0
    old = state.iterate._replace(cost=jnp.where(is_polishing, jnp.inf, state.iterate.cost))
    iterate = levenberg.step(arm, goal, old, config)
    is_solved = _is_within(iterate, config)
    preference = jnp.where(is_solved, _preference(problem, iterate.joints), jnp.inf)
    is_better = (preference < state.preference) | (jnp.isinf(state.preference) & (iterate.cost < state.cost))
    polish = jnp.where(is_polishing | is_solved, state.polish + 1, state.polish)
    sharp = iterate._replace(damping=jnp.float32(levenberg.DAMPING_RANGE[0]))
    change = levenberg.update(goal, sharp, -PREFERENCE_RATE * _preference_slope(problem, iterate.joints))
    along = levenberg.moved(goal, iterate.joints, change, PREFERENCE_STEP)
    is_spent = (polish < 0) & (state.iterations + 1 >= config.num_iterations)
    is_last = is_spent & (state.start + 1 >= config.num_seeds)
    restarted = levenberg.begin(_start(problem, state.start + 1), config)
    iterate = iterate._replace(trial=jnp.where(polish >= 0, along, iterate.trial))
    new = _State(
        iterate=tree_where(is_spent, restarted, iterate),
        start=jnp.where(is_spent & ~is_last, state.start + 1, state.start),
        iterations=jnp.where(is_spent, 0, state.iterations + 1),
        polish=polish,
        joints=jnp.where(is_better, iterate.joints, state.joints),
        cost=jnp.where(is_better, iterate.cost, state.cost),
        preference=jnp.minimum(preference, state.preference),
        is_done=is_last | (polish >= config.num_nullspace_steps),
    )
    return tree_where(state.is_done, state, new)


def _is_within(iterate: Iterate, config: IKConfig) -> Array:
    rotation = config.rotation_tolerance * levenberg.ROTATION_WEIGHT
    # A tenth stays in hand, since the angle is measured in another way at the end.
    return (jnp.sum(iterate.error[:3] ** 2) < (0.9 * config.position_tolerance) ** 2) & (
        jnp.sum(iterate.error[3:] ** 2) < (0.9 * rotation) ** 2
    )


def _preference(problem: _Problem, joints: Array) -> Array:
    near = 0.5 * jnp.sum((joints - problem.present) ** 2)
    return near + 0.5 * LIMIT_WEIGHT * jnp.sum(_excess(problem.goal, joints)[0] ** 2)


def _preference_slope(problem: _Problem, joints: Array) -> Array:
    excess, slope = _excess(problem.goal, joints)
    return joints - problem.present + LIMIT_WEIGHT * excess * slope


def _excess(goal: Goal, joints: Array) -> tuple[Array, Array]:
    """Returns f32[J] from 0 at the last tenth of the range to +-1 at its end, and its derivative."""
    width = LIMIT_SHARE * (goal.upper - goal.lower)
    low, high = goal.lower + width - joints, joints - (goal.upper - width)
    return (jnp.maximum(high, 0.0) - jnp.maximum(low, 0.0)) / width, 1.0 / width


def _start(problem: _Problem, index: Array) -> Array:
    spread = _spread(problem.goal.lower, problem.goal.upper, index.astype(jnp.float32))
    return jnp.where(index == 0, problem.present, spread)


def _spread(lower: Array, upper: Array, index: Array) -> Array:
    """Returns f32[J], the start number `index` (f32[]) of a low-discrepancy sequence over the limits.

    Source: Roberts, The unreasonable effectiveness of quasirandom sequences (2018): steps are powers of the root of
    x^(d + 1) = x + 1.
    """
    dimension = lower.shape[0]
    root = 2.0
    for _ in range(60):
        root = (1.0 + root) ** (1.0 / (dimension + 1))
    steps = np.float32(root) ** -np.arange(1, dimension + 1, dtype=np.float32)
    return lower + jnp.mod(0.5 + index * steps, 1.0) * (upper - lower)
