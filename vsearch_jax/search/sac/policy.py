"""The policy as a searcher: one episode."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
from brax.envs.base import State
from jax import Array

from vsearch_jax.config import Config
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
from vsearch_jax.types import EpisodeState, PolicyEnd, SearchResult, View
from vsearch_jax.xla.tree import tree_where

_IMPROVEMENT = 3e-3
"""A step that raises the best cosine by less comes no nearer."""
_NEAR = 0.9
"""From this cosine on, the target is some ten degrees off at most."""
_FOUND_RADIUS = math.radians(3.0)
"""About how far from the target views still meet the threshold."""

StepFn = Callable[[State, Array], State]
"""The environment's `step`, (state, action) -> state; to this searcher what `ScoreFn` is to the others."""


@flax.struct.dataclass
class PolicyTask:
    """What `SearchArgs.task` holds for this searcher.

    Attributes:
      actor: parameters of the policy.
      start: brax State of a started episode: `pipeline_state.observation.view`, `metrics["similarity"]` and
        `info["is_reachable"]` tell what was seen.
    """

    actor: Any
    start: State


@flax.struct.dataclass
class _Carry:
    """State of the loop.

    Attributes:
      record: Record.
      state: brax State.
      num_helped: i32[], steps that were not the policy's.
      num_around: i32[], those of them around the best view, since that has come nearer.
      costs: f32[2], travel in rad and duration in s of the motions so far.
    """

    record: Record
    state: State
    num_helped: Array
    num_around: Array
    costs: Array


def search(key: Array, step_fn: StepFn, args: SearchArgs, config: Config) -> SearchResult:
    """Follows the policy until the threshold is met or the episode is out of steps.

    The policy acts by its mean. In some episodes in a thousand that goes round in a circle, mostly a little beside the
    target. So where a step came no nearer, and the best view is near the target or `config.evaluation.patience` steps
    are done, the next step is not the policy's:

    - With the best view near the target, 1 - c tells how far that is, as it grows with the square of the distance, but
      not where. The steps go around the best view at that distance, a quarter turn each, then at twice the distance.
    - Else they sweep around the object, in one direction, with random elevations.

    A step of this kind also follows one that the arm could not do, which a mean would repeat for ever.

    A step is one generation of one image; as a policy is measured by its episode length, the image of the start does
    not count. An episode is at least one step long, as in training, where the start may meet the threshold already.

    Args:
      key: PRNG key of the random steps.
      step_fn: the environment's `step`.
      args: SearchArgs of one problem, its `task` a PolicyTask; `initial` is that of the task.
      config: the run's; `sac`, `env` and `evaluation.patience` are read.

    Returns:
      SearchResult with best_scores f32[episode_length] and `end`, a PolicyEnd. Its `view` and `score` are those of the
      end, where the arm stands, not the best of the way.
    """
    start: State = args.task.start
    record = start_record(args.initial, jnp.asarray(-jnp.inf, jnp.float32), config.env.episode_length)
    record = dataclasses.replace(record, evaluations=jnp.int32(0), unreachable=jnp.int32(0))
    carry = _Carry(record=record, state=start, num_helped=jnp.int32(0), num_around=jnp.int32(0), costs=jnp.zeros(2))
    body = functools.partial(_step, key, step_fn, args, config)
    carry = jax.lax.while_loop(lambda carry: is_running(carry.record, args.threshold), body, carry)
    result, end = to_result(carry.record), PolicyEnd(carry.state, carry.num_helped, *carry.costs)
    return dataclasses.replace(result, view=_view(end.state), score=end.state.metrics["similarity"], end=end)


def _step(key: Array, step_fn: StepFn, args: SearchArgs, config: Config, carry: _Carry) -> _Carry:
    record, state = carry.record, carry.state
    steps = record.generation
    is_near = record.score >= _NEAR
    # Before the second step there is nothing to compare with.
    has_improved = (steps < 2) | (record.score > record.best_scores[steps - 2] + _IMPROVEMENT)
    is_helped = ~has_improved & ((steps >= config.evaluation.patience) | is_near)
    is_helped |= state.info["is_reachable"] < 0.5
    num_around = jnp.where(has_improved, 0, carry.num_around)

    around_key, sweep_key = jax.random.split(key)  # the same at every step, so that the turns go on
    around = _around_best(around_key, record, num_around, args)
    swept = _swept(sweep_key, steps, state, args.band, config)
    view = tree_where(is_near, around, swept)
    observation: Array = state.obs  # pyright: ignore[reportAssignmentType] # brax allows dictionaries too
    action = act(None, args.task.actor, observation, config.sac)
    state = step_fn(state, jnp.where(is_helped, _action_to(view, state, config), action))
    score = jnp.where(state.info["is_reachable"] > 0.5, state.metrics["similarity"], -jnp.inf)
    views, scores = jax.tree.map(lambda x: x[None], (_view(state), score))
    return _Carry(
        record=add_generation(record, views, scores, args.threshold),
        state=state,
        num_helped=carry.num_helped + is_helped.astype(jnp.int32),
        num_around=num_around + (is_helped & is_near).astype(jnp.int32),
        costs=carry.costs + jnp.stack([state.metrics["joint_travel"], state.metrics["motion_time"]]),
    )


def _around_best(key: Array, record: Record, number: Array, args: SearchArgs) -> View:
    """Returns view `number` (i32[]) of those around the best one: four at its distance, four further."""
    missing = jnp.maximum(1.0 - record.score, 0.0) / (1.0 - args.threshold)
    turn, turns = number.astype(jnp.float32), (number // 4).astype(jnp.float32)
    radius = _FOUND_RADIUS * jnp.sqrt(missing) * (1.0 + turns)
    angle = 2.0 * jnp.pi * jax.random.uniform(key) + 0.5 * jnp.pi * turn + 0.25 * jnp.pi * turns
    return View(
        azimuth=wrap_angle(record.view.azimuth + radius * jnp.cos(angle)),
        elevation=fold_into_band(record.view.elevation + radius * jnp.sin(angle), args.band),
    )


def _swept(key: Array, steps: Array, state: State, band: Array, config: Config) -> View:
    """Returns a view that lies a step further round the object, in the same direction at every step."""
    side_key, elevation_key = jax.random.split(key)
    side = jax.random.rademacher(side_key, (), jnp.float32)
    return View(
        azimuth=wrap_angle(_view(state).azimuth + side * math.radians(config.env.action_scale_deg)),
        elevation=jax.random.uniform(jax.random.fold_in(elevation_key, steps), (), jnp.float32, *band),
    )


def _action_to(view: View, state: State, config: Config) -> Array:
    """Returns f32[2], the action to `view`, or towards it where it is further than a step."""
    here = _view(state)
    change = jnp.stack([wrap_angle(view.azimuth - here.azimuth), view.elevation - here.elevation])
    return jnp.clip(change / math.radians(config.env.action_scale_deg), -1.0, 1.0)


def _view(state: State) -> View:
    episode: EpisodeState = state.pipeline_state  # pyright: ignore[reportAssignmentType] # brax lets any pytree stand here
    return episode.observation.view
