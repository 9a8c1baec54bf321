"""The policy as a searcher: one search is one episode."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable

import flax.struct
import jax
import jax.numpy as jnp
from brax.envs.base import State
from flax import nnx
from jax import Array

from vsearch_jax.config import Config
from vsearch_jax.env import episode_of, obs_of
from vsearch_jax.geometry import wrap_angle
from vsearch_jax.search.common import (
    Record,
    SearchArgs,
    add_generation,
    fold_into_band,
    is_running,
    start_record,
    to_result,
)
from vsearch_jax.search.sac.agent import act
from vsearch_jax.types import PolicyEnd, SearchResult, View
from vsearch_jax.xla.tree import tree_where

# A step makes progress if it raises the best score by more than this.
_MIN_IMPROVEMENT = 3e-3
# A view with at least this score is near the target: about 10 degrees away at most.
_NEAR_SCORE = 0.9
# Approximate distance from the target at which a view meets the threshold, in rad.
_FOUND_RADIUS = math.radians(3.0)

StepFn = Callable[[State, Array], State]
"""The environment's `step`: (state, action) -> state. It takes the place of `ScoreFn` for this searcher."""


@flax.struct.dataclass
class PolicyTask:
    """The field `task` of this searcher's SearchArgs.

    Attributes:
      actor: parameters of the policy.
      start: brax State at the start of the episode. `pipeline_state` is an EpisodeState. `metrics` has `similarity`,
        `joint_travel` and `motion_time`. `info` has `is_reachable`.
    """

    actor: nnx.State
    start: State


@flax.struct.dataclass
class _LoopState:
    """State of the loop over the steps of an episode.

    Attributes:
      record: Record.
      state: brax State.
      num_helped: i32[], number of steps that the local search chose.
      num_around: i32[], number of local search steps around the present best view.
      costs: f32[2], travel in rad and duration in s, summed over the motions so far.
    """

    record: Record
    state: State
    num_helped: Array
    num_around: Array
    costs: Array


def search(key: Array, step_fn: StepFn, args: SearchArgs[PolicyTask], config: Config) -> SearchResult:
    """Searches for the target view with a trained policy in one episode. A local search helps where the policy stalls.

    The episode ends when the similarity meets the threshold or after `config.env.episode_length` steps. The policy
    takes its mean action. In a few of 1000 episodes the policy would move in a circle, mostly near the target. There a
    local search chooses the step instead of the policy. It does so if the step before made no progress, and the best
    view is near the target or `config.evaluation.patience` steps are done. It also does so after a step that the arm
    could not do. The policy would repeat that step forever, because its action depends on its input only.

    The local search has two kinds of steps:

    - Near the target it tries views around the best view. The distance of these views from the best view is an estimate
      of the target's distance: 1 - score grows with the square of that distance. The direction of the target is
      unknown. Therefore the direction turns by 90 degrees in each step. After every 4 steps the distance grows.
    - Far from the target it moves around the object in one direction, with random elevations.

    Each step takes one image. The image of the initial view is not counted, because the result of a
    policy is its number of steps. An episode has at least one step, even if the initial view meets the threshold, as in
    training.

    Args:
      key: PRNG key of the local search.
      step_fn: the environment's `step`.
      args: the search problem. `task` holds the policy and the brax State at the start; `initial` is the view there.
      config: the run's config. Only `sac`, `env` and `evaluation.patience` are used.

    Returns:
      Last view of the episode (not the best one), its score, and the number of steps. best_scores is
      f32[episode_length]. `end` holds the last brax State and the cost of the motions.
    """
    record = start_record(args.initial, jnp.asarray(-jnp.inf, jnp.float32), config.env.episode_length)
    record = dataclasses.replace(record, evaluations=jnp.int32(0), unreachable=jnp.int32(0))
    zero = jnp.int32(0)
    loop = _LoopState(record=record, state=args.task.start, num_helped=zero, num_around=zero, costs=jnp.zeros(2))
    body = functools.partial(_run_step, key, step_fn, args, config)
    loop = jax.lax.while_loop(lambda loop: is_running(loop.record, args.threshold), body, loop)
    result, end = to_result(loop.record), PolicyEnd(loop.state, loop.num_helped, *loop.costs)
    return dataclasses.replace(result, view=_present_view(end.state), score=end.state.metrics["similarity"], end=end)


def _run_step(
    key: Array, step_fn: StepFn, args: SearchArgs[PolicyTask], config: Config, loop: _LoopState
) -> _LoopState:
    record, state = loop.record, loop.state
    num_steps = record.generation
    is_near = record.score >= _NEAR_SCORE
    # The first two steps count as progress, because there is no earlier score to compare with.
    has_improved = (num_steps < 2) | (record.score > record.best_scores[num_steps - 2] + _MIN_IMPROVEMENT)
    is_helped = ~has_improved & ((num_steps >= config.evaluation.patience) | is_near)
    is_helped |= state.info["is_reachable"] < 0.5
    num_around = jnp.where(has_improved, 0, loop.num_around)

    # The keys are equal in every step, so that the first angle and the sweep's direction stay.
    around_key, sweep_key = jax.random.split(key)
    around = _view_around_best(around_key, record, num_around, args)
    sweep = _sweep_view(sweep_key, num_steps, state, args.band, config)
    view = tree_where(is_near, around, sweep)
    action = act(None, args.task.actor, obs_of(state), config.sac)
    state = step_fn(state, jnp.where(is_helped, _action_towards(view, state, config), action))
    score = jnp.where(state.info["is_reachable"] > 0.5, state.metrics["similarity"], -jnp.inf)
    views, scores = jax.tree.map(lambda x: x[None], (_present_view(state), score))
    return _LoopState(
        record=add_generation(record, views, scores, args.threshold),
        state=state,
        num_helped=loop.num_helped + is_helped.astype(jnp.int32),
        num_around=num_around + (is_helped & is_near).astype(jnp.int32),
        costs=loop.costs + jnp.stack([state.metrics["joint_travel"], state.metrics["motion_time"]]),
    )


def _view_around_best(key: Array, record: Record, num_around: Array, args: SearchArgs[PolicyTask]) -> View:
    """Returns the view around the best view that follows `num_around` (i32[]) others.

    The first four views lie on a circle, 90 degrees apart. Its radius is the estimated distance of the target. Each
    further circle is wider by this radius and turned by 45 degrees.
    """
    missing = jnp.maximum(1.0 - record.score, 0.0) / (1.0 - args.threshold)
    quarters, circles = num_around.astype(jnp.float32), (num_around // 4).astype(jnp.float32)
    radius = _FOUND_RADIUS * jnp.sqrt(missing) * (1.0 + circles)
    angle = 2.0 * jnp.pi * jax.random.uniform(key) + 0.5 * jnp.pi * quarters + 0.25 * jnp.pi * circles
    return View(
        azimuth=wrap_angle(record.view.azimuth + radius * jnp.cos(angle)),
        elevation=fold_into_band(record.view.elevation + radius * jnp.sin(angle), args.band),
    )


def _sweep_view(key: Array, num_steps: Array, state: State, band: Array, config: Config) -> View:
    """Returns a view of random elevation, one step further around the object. The direction depends on `key` only."""
    direction_key, elevation_key = jax.random.split(key)
    direction = jax.random.rademacher(direction_key, (), jnp.float32)
    return View(
        azimuth=wrap_angle(_present_view(state).azimuth + direction * math.radians(config.env.action_scale_deg)),
        elevation=jax.random.uniform(jax.random.fold_in(elevation_key, num_steps), (), jnp.float32, *band),
    )


def _action_towards(view: View, state: State, config: Config) -> Array:
    """Returns the action f32[2] that leads to `view`, or as close to it as one step can."""
    present = _present_view(state)
    change = jnp.stack([wrap_angle(view.azimuth - present.azimuth), view.elevation - present.elevation])
    return jnp.clip(change / math.radians(config.env.action_scale_deg), -1.0, 1.0)


def _present_view(state: State) -> View:
    return episode_of(state).observation.view
