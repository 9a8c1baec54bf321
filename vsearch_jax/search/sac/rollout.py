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
    is_running,
    sample_around_best,
    start_record,
    to_result,
)
from vsearch_jax.search.sac.agent import act
from vsearch_jax.types import EpisodeState, SearchResult, View

_IMPROVEMENT = 3e-3
"""A step that raises the best cosine by less comes no nearer."""
_NEAR = 0.9
"""From this cosine on, the target is some ten degrees off."""
_SAMPLES, _SWEEPS, _TRIES = 3, 2, 4
"""Steps in a turn of help: of random search, of a sweep, of the policy."""

StepFn = Callable[[State, Array], State]
"""The environment's `step`, (state, action) -> state; to this searcher what `ScoreFn` is to the others."""


@flax.struct.dataclass
class PolicyTask:
    """What `SearchArgs.task` holds for this searcher.

    Attributes:
      actor: parameters of the policy.
      start: brax State of a started episode: `pipeline_state.sight.view`, `metrics["similarity"]` and
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
      lost_at: i32[], the step from which on the policy is helped; the episode's length while it is not.
    """

    record: Record
    state: State
    lost_at: Array


def search(key: Array, step_fn: StepFn, args: SearchArgs, config: Config) -> SearchResult:
    """Follows the policy until the threshold is met or the episode is out of steps.

    The policy acts by its mean. In some episodes in a thousand that goes round in a circle beside the target. So one
    that no longer comes nearer, once it is near or after `config.evaluation.patience` steps, is helped in turns: three
    steps of random search (thesis 4.1), to views around the best one of the way; two steps of a sweep around the
    object; four of the policy, which now comes from elsewhere. Where the best view is far from the target it sweeps
    until the cosine rises. One step of help also follows one that the arm could not do, which a mean would repeat for
    ever.

    A step is one generation of one image; as a policy is measured by its episode length, the image of the start does
    not count. An episode is at least one step long, as in training, where the start may meet the threshold already.

    Args:
      key: PRNG key of the random steps.
      step_fn: the environment's `step`.
      args: SearchArgs of one problem, its `task` a PolicyTask; `initial` and `initial_score` are those of the task.
      config: the run's; `sac`, `env`, `evaluation.patience` and `random_search.k` are read.

    Returns:
      SearchResult with best_scores f32[episode_length] and the State at the end of the episode. Its `view` and `score`
      are those of the end, where the arm stands, not the best of the way.
    """
    start: State = args.task.start
    record = start_record(args.initial, jnp.asarray(-jnp.inf, jnp.float32), config.env.episode_length)
    record = dataclasses.replace(record, evaluations=jnp.int32(0), unreachable=jnp.int32(0))
    carry = _Carry(record=record, state=start, lost_at=jnp.int32(config.env.episode_length))
    body = functools.partial(_step, key, step_fn, args, config)
    carry = jax.lax.while_loop(lambda carry: is_running(carry.record, args.threshold), body, carry)
    result, end = to_result(carry.record), carry.state
    return dataclasses.replace(result, view=_view(end), score=end.metrics["similarity"], end=end)


def _step(key: Array, step_fn: StepFn, args: SearchArgs, config: Config, carry: _Carry) -> _Carry:
    record, state = carry.record, carry.state
    steps = record.generation
    is_near = record.score >= _NEAR
    has_improved = record.score - record.best_scores[steps - 2] > _IMPROVEMENT
    is_lost = ~has_improved & ((steps >= config.evaluation.patience) | (is_near & (steps >= 2)))
    lost_at = jnp.minimum(carry.lost_at, jnp.where(is_lost, steps, config.env.episode_length))
    turn = (steps - lost_at) % (_SAMPLES + _SWEEPS + _TRIES)
    is_helped = (steps >= lost_at) & (turn < _SAMPLES + _SWEEPS) & (is_near | ~has_improved)
    is_helped |= state.info["is_reachable"] < 0.5
    is_sampled = is_near & ((steps < lost_at) | (turn < _SAMPLES))

    view = _random_view(key, record, state, args.band, config)
    view = jax.tree.map(lambda near, swept: jnp.where(is_sampled, near, swept), *view)
    observation: Array = state.obs  # pyright: ignore[reportAssignmentType] # brax allows dictionaries too
    action = act(None, args.task.actor, observation, config.sac)
    state = step_fn(state, jnp.where(is_helped, _action_to(view, state, config), action))
    score = jnp.where(state.info["is_reachable"] > 0.5, state.metrics["similarity"], -jnp.inf)
    views, scores = jax.tree.map(lambda x: x[None], (_view(state), score))
    return _Carry(record=add_generation(record, views, scores, args.threshold), state=state, lost_at=lost_at)


def _random_view(key: Array, record: Record, state: State, band: Array, config: Config) -> tuple[View, View]:
    """Returns a view around the best one, and one that lies a step further round the object."""
    side_key, sample_key, elevation_key = jax.random.split(key, 3)
    sample_key, elevation_key = (jax.random.fold_in(k, record.generation) for k in (sample_key, elevation_key))
    near = sample_around_best(sample_key, record, band, config.random_search.k, 1)
    side = jax.random.rademacher(side_key, (), jnp.float32)  # the same in all steps
    swept = View(
        azimuth=wrap_angle(_view(state).azimuth + side * math.radians(config.env.action_scale_deg)),
        elevation=jax.random.uniform(elevation_key, (), jnp.float32, *band),
    )
    return View(near.azimuth[0], near.elevation[0]), swept


def _action_to(view: View, state: State, config: Config) -> Array:
    """Returns f32[2], the action to `view`, or towards it where it is further than a step."""
    here = _view(state)
    change = jnp.stack([wrap_angle(view.azimuth - here.azimuth), view.elevation - here.elevation])
    return jnp.clip(change / math.radians(config.env.action_scale_deg), -1.0, 1.0)


def _view(state: State) -> View:
    episode: EpisodeState = state.pipeline_state  # pyright: ignore[reportAssignmentType] # brax lets any pytree stand here
    return episode.sight.view
