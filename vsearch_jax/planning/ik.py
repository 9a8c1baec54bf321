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
from vsearch_jax.planning import lane_counts, levenberg
from vsearch_jax.planning.levenberg import Goal, Iterate
from vsearch_jax.planning.starts import build_result, finite_joints
from vsearch_jax.robot.arm import Arm, forward_kinematics, is_free
from vsearch_jax.types import IKResult
from vsearch_jax.xla import lane_pool
from vsearch_jax.xla.batching import flatten_vmap
from vsearch_jax.xla.tree import tree_where

# How often a solution in contact is replaced by one from later starts.
NUM_RETRIES = 2
# Weight of a joint at its limit in the preference. It rises from 0 over this share of the joint's range.
LIMIT_WEIGHT, LIMIT_SHARE = 0.05, 0.1
# Share of the preference's gradient that one step follows, and the longest step of one joint in rad or m.
PREFERENCE_RATE, PREFERENCE_STEP = 0.5, 0.25


class _Problem(NamedTuple):
    """One IK problem.

    Attributes:
      goal: wanted camera pose, and the joint limits.
      present: f32[J] rad or m, the present joints of the chain, finite.
      first_start: i32[], number of the first start to try.
    """

    goal: Goal
    present: Array
    first_start: Array


class _LaneState(NamedTuple):
    """State of a lane.

    Attributes:
      iterate: of the present start. After convergence it moves along the nullspace.
      start: i32[], number of the present start.
      iterations: i32[], done from this start.
      num_nullspace_steps: i32[], done; -1 before convergence.
      joints: f32[J] rad or m, the best found so far.
      cost: f32[], of `joints`; not updated after convergence.
      preference: f32[], of `joints`; +inf before convergence.
      is_done: bool[].
    """

    iterate: Iterate
    start: Array
    iterations: Array
    num_nullspace_steps: Array
    joints: Array
    cost: Array
    preference: Array
    is_done: Array


class _Solution(NamedTuple):
    """What a lane returns.

    Attributes:
      joints: f32[J] rad or m.
      is_solved: bool[], whether they solve the problem.
      next_start: i32[], number of the start after the last one tried.
    """

    joints: Array
    is_solved: Array
    next_start: Array


def ik(arm: Arm, T_world_camera: SE3, qpos: Array, config: IKConfig) -> IKResult:
    """Returns joints that bring the wrist camera to `T_world_camera`.

    The first start is `qpos`. `config.num_seeds - 1` other starts are spread evenly over the limits. From the first
    start that converges, nullspace steps bring the arm near `qpos` and away from its limits. If that solution is in
    contact, more starts are tried until a solution is without contact. If no start converges, the result has the
    smallest error found. Joints that do not move the camera (fingers, loose parts) do not change.

    Under `vmap` the problems share a fixed number of lanes: each lane solves one problem after another, so no problem
    waits for the slowest (see `xla.lane_pool` and `planning.lane_counts`). `vmap` over the arm raises
    NotImplementedError.

    Args:
      arm: the arm.
      T_world_camera: wanted pose of the wrist camera in world.
      qpos: f32[nq] rad or m, the present joints. A value that is not finite is replaced by the middle of the limits;
        the result is then not converged, and its status is NOT_FINITE.
      config: iterations, damping, tolerances, number of starts, and whether the camera may roll.
    """
    solve = flatten_vmap(functools.partial(_solve_batch, config))
    poses = (T_world_camera.translation()[None], T_world_camera.rotation().as_matrix()[None])
    result = solve(arm, (*poses, qpos[None]))
    return jax.tree.map(lambda leaf: leaf[0], result)


def _solve_batch(config: IKConfig, arm: Arm, batch: tuple[Array, Array, Array]) -> IKResult:
    """Solves N problems: positions f32[N, 3], rotations f32[N, 3, 3] and qpos f32[N, nq]."""
    positions, rotations, qpos = batch
    count, address = qpos.shape[0], arm.chain.address
    finite = jax.vmap(functools.partial(finite_joints, arm))(qpos)
    limits = [jnp.broadcast_to(limit[address][None], (count, len(address))) for limit in (arm.lower, arm.upper)]
    goal = Goal(positions, rotations, *limits)
    problems = _Problem(goal, finite[:, address], jnp.zeros(count, jnp.int32))
    unsolved = _Solution(finite[:, address], jnp.zeros(count, bool), jnp.zeros(count, jnp.int32))

    def attempt(index: Array, state: tuple[_Solution, Array]) -> tuple[_Solution, Array]:
        best, is_clear = state
        is_retry = best.is_solved & ~is_clear & (best.next_start < config.num_seeds)
        is_open = is_retry | (index == 0)
        new = _solve_open(arm, config, problems._replace(first_start=best.next_start), is_open, best)
        is_new_clear = _are_free(arm, new.joints, finite, is_open & new.is_solved)
        joints = jnp.where((is_new_clear | (index == 0))[:, None], new.joints, best.joints)
        return _Solution(joints, new.is_solved | best.is_solved, new.next_start), is_clear | is_new_clear

    # One loop holds the first attempt and the retries, so its body is compiled once.
    found, _ = jax.lax.fori_loop(0, 1 + NUM_RETRIES, attempt, (unsolved, jnp.zeros(count, bool)))
    solution = finite.at[:, address].set(found.joints)
    data = jax.vmap(functools.partial(forward_kinematics, arm))(solution)
    return jax.vmap(functools.partial(build_result, arm, config))(goal, data, qpos)


def _are_free(arm: Arm, joints: Array, qpos: Array, is_open: Array) -> Array:
    """Returns bool[N]: no contact at `qpos` (f32[N, nq]) with `joints` (f32[N, J]); False where not `is_open`."""

    def step(problem: tuple[Array, Array], _: Array) -> Array:
        chain, others = problem
        free = is_free(arm, forward_kinematics(arm, others.at[arm.chain.address].set(chain)))
        return jnp.where(free, 1, 0)

    # A lane's state is i32[]: -1 unknown, 0 in contact, 1 free.
    job = lane_pool.Job(
        reset=lambda _, state, is_new: jnp.where(is_new, -1, state),
        step=step,
        is_done=lambda state: state >= 0,
        result=lambda _, state: state > 0,
        has_stragglers=False,
    )
    num_lanes = min(lane_counts.current().ik, is_open.shape[0])
    results, states = jnp.zeros(is_open.shape, bool), jnp.zeros(num_lanes, jnp.int32)
    return lane_pool.run(job, (joints, qpos), lane_pool.queue_where(is_open), states, results)


def _solve_open(arm: Arm, config: IKConfig, problems: _Problem, is_open: Array, solutions: _Solution) -> _Solution:
    """Solves the problems where `is_open` (bool[N]); returns the given solutions elsewhere."""
    job = lane_pool.Job(
        functools.partial(_reset_lane, config),
        functools.partial(_step_lane, arm, config),
        lambda state: state.is_done,
        lambda _, state: _Solution(state.joints, jnp.isfinite(state.preference), state.start + 1),
    )
    num_lanes = min(lane_counts.current().ik, is_open.shape[0])
    first = jax.tree.map(lambda leaf: leaf[:num_lanes], problems)
    states = jax.vmap(functools.partial(_start_lane, config))(first)
    return lane_pool.run(job, problems, lane_pool.queue_where(is_open), states, solutions)


def _start_lane(config: IKConfig, problem: _Problem) -> _LaneState:
    start = _start_joints(problem, problem.first_start)
    zero, infinite = jnp.int32(0), jnp.float32(jnp.inf)
    iterate = levenberg.start_iterate(start, config)
    return _LaneState(iterate, problem.first_start, zero, jnp.int32(-1), start, infinite, infinite, jnp.bool_(False))


def _reset_lane(config: IKConfig, problem: _Problem, state: _LaneState, is_new: Array) -> _LaneState:
    return tree_where(is_new, _start_lane(config, problem), state)


def _step_lane(arm: Arm, config: IKConfig, problem: _Problem, state: _LaneState) -> _LaneState:
    """Evaluates the kinematics once: for Levenberg-Marquardt before convergence, for a nullspace step after it."""
    goal, has_converged = problem.goal, state.num_nullspace_steps >= 0
    # After convergence every trial is accepted.
    old = state.iterate._replace(cost=jnp.where(has_converged, jnp.inf, state.iterate.cost))
    iterate = levenberg.advance_iterate(arm, goal, old, config)
    is_solved = _is_within_tolerances(iterate, config)
    preference = jnp.where(is_solved, _preference(problem, iterate.joints), jnp.inf)
    is_better = (preference < state.preference) | (jnp.isinf(state.preference) & (iterate.cost < state.cost))
    num_nullspace_steps = jnp.where(has_converged | is_solved, state.num_nullspace_steps + 1, state.num_nullspace_steps)
    nullspace_trial = _nullspace_trial(problem, iterate)
    is_spent = (num_nullspace_steps < 0) & (state.iterations + 1 >= config.num_iterations)
    is_last = is_spent & (state.start + 1 >= config.num_seeds)
    restarted = levenberg.start_iterate(_start_joints(problem, state.start + 1), config)
    iterate = iterate._replace(trial=jnp.where(num_nullspace_steps >= 0, nullspace_trial, iterate.trial))
    new = _LaneState(
        iterate=tree_where(is_spent, restarted, iterate),
        start=jnp.where(is_spent & ~is_last, state.start + 1, state.start),
        iterations=jnp.where(is_spent, 0, state.iterations + 1),
        num_nullspace_steps=num_nullspace_steps,
        joints=jnp.where(is_better, iterate.joints, state.joints),
        cost=jnp.where(is_better, iterate.cost, state.cost),
        preference=jnp.minimum(preference, state.preference),
        is_done=is_last | (num_nullspace_steps >= config.num_nullspace_steps),
    )
    return tree_where(state.is_done, state, new)


def _nullspace_trial(problem: _Problem, iterate: Iterate) -> Array:
    """Returns joints f32[J] that have a lower preference and, to first order, the same camera pose."""
    undamped = iterate._replace(damping=jnp.float32(levenberg.DAMPING_RANGE[0]))
    preferred = -PREFERENCE_RATE * _preference_gradient(problem, iterate.joints)
    change = levenberg.compute_step(problem.goal, undamped, preferred)
    return levenberg.apply_step(problem.goal, iterate.joints, change, PREFERENCE_STEP)


def _is_within_tolerances(iterate: Iterate, config: IKConfig) -> Array:
    rotation = config.rotation_tolerance * levenberg.ROTATION_WEIGHT
    # The factor 0.9 leaves a reserve, because `build_result` measures the angle in another way.
    return (jnp.sum(iterate.error[:3] ** 2) < (0.9 * config.position_tolerance) ** 2) & (
        jnp.sum(iterate.error[3:] ** 2) < (0.9 * rotation) ** 2
    )


def _preference(problem: _Problem, joints: Array) -> Array:
    """Returns f32[]; low near the present joints and away from the limits."""
    near = 0.5 * jnp.sum((joints - problem.present) ** 2)
    return near + 0.5 * LIMIT_WEIGHT * jnp.sum(_limit_excess(problem.goal, joints)[0] ** 2)


def _preference_gradient(problem: _Problem, joints: Array) -> Array:
    excess, slope = _limit_excess(problem.goal, joints)
    return joints - problem.present + LIMIT_WEIGHT * excess * slope


def _limit_excess(goal: Goal, joints: Array) -> tuple[Array, Array]:
    """Returns f32[J] and its slope: 0 inside, and a linear rise from 0 to +-1 over the last tenth of the range."""
    width = LIMIT_SHARE * (goal.upper - goal.lower)
    low, high = goal.lower + width - joints, joints - (goal.upper - width)
    return (jnp.maximum(high, 0.0) - jnp.maximum(low, 0.0)) / width, 1.0 / width


def _start_joints(problem: _Problem, index: Array) -> Array:
    """Returns start number `index` (i32[]): the present joints for 0, points spread over the limits for others."""
    spread = _quasirandom_joints(problem.goal.lower, problem.goal.upper, index.astype(jnp.float32))
    return jnp.where(index == 0, problem.present, spread)


def _quasirandom_joints(lower: Array, upper: Array, index: Array) -> Array:
    """Returns f32[J], point number `index` (f32[]) of a low-discrepancy sequence between the limits.

    Source: Roberts, The unreasonable effectiveness of quasirandom sequences (2018). The steps of the coordinates are
    powers of 1 / x, where x is the root of x^(d + 1) = x + 1.
    """
    dimension = lower.shape[0]
    root = 2.0
    for _ in range(60):
        root = (1.0 + root) ** (1.0 / (dimension + 1))
    steps = np.float32(root) ** -np.arange(1, dimension + 1, dtype=np.float32)
    return lower + jnp.mod(0.5 + index * steps, 1.0) * (upper - lower)
