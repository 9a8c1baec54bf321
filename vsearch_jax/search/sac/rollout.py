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
"""From this cosine on, some ten degrees off, random search alone is the quicker way."""

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


def search(key: Array, step_fn: StepFn, args: SearchArgs, config: Config) -> SearchResult:
    """Follows the policy until the threshold is met or the episode is out of steps.

    The policy acts by its mean. Half a turn takes six steps of 30 degrees; a policy that has not arrived after
    `config.evaluation.patience` steps, and no longer comes nearer, goes round in a circle, mostly a little beside the
    target. The next step is then one of random search (SPEC.md 5): to a random view around the best one of the way, or
    as far towards it as a step leads. Where the best view is far from the target, it is a step of a sweep around the
    object instead, from which the policy takes over when the cosine rises. The same step follows one that the arm could
    not do, which the policy's mean would repeat for ever.

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
    body = functools.partial(_step, key, step_fn, args, config)
    record, end = jax.lax.while_loop(lambda carry: is_running(carry[0], args.threshold), body, (record, start))
    return dataclasses.replace(to_result(record), view=_view(end), score=end.metrics["similarity"], end=end)


def _step(
    key: Array, step_fn: StepFn, args: SearchArgs, config: Config, carry: tuple[Record, State]
) -> tuple[Record, State]:
    record, state = carry
    observation: Array = state.obs  # pyright: ignore[reportAssignmentType] # brax allows dictionaries too
    is_lost = record.generation >= config.evaluation.patience
    is_lost &= record.score - record.best_scores[record.generation - 2] <= _IMPROVEMENT
    is_lost |= state.info["is_reachable"] < 0.5
    random_action = _random_action(key, record, state, args.band, config)
    state = step_fn(state, jnp.where(is_lost, random_action, act(None, args.task.actor, observation, config.sac)))
    score = jnp.where(state.info["is_reachable"] > 0.5, state.metrics["similarity"], -jnp.inf)
    views, scores = jax.tree.map(lambda x: x[None], (_view(state), score))
    return add_generation(record, views, scores, args.threshold), state


def _random_action(key: Array, record: Record, state: State, band: Array, config: Config) -> Array:
    """Returns f32[2], the action to, or towards, a random view: around the best one, or further round the object."""
    sweep_key, sample_key, elevation_key = jax.random.split(key, 3)
    near = sample_around_best(
        jax.random.fold_in(sample_key, record.generation), record, band, config.random_search.k, 1
    )
    here, scale = _view(state), math.radians(config.env.action_scale_deg)
    way_round = scale * jax.random.rademacher(sweep_key, (), jnp.float32)  # the same in all steps
    elevation = jax.random.uniform(jax.random.fold_in(elevation_key, record.generation), (), jnp.float32, *band)
    is_near = record.score >= _NEAR
    azimuth = jnp.where(is_near, near.azimuth[0], here.azimuth + way_round)
    elevation = jnp.where(is_near, near.elevation[0], elevation)
    change = jnp.stack([wrap_angle(azimuth - here.azimuth), elevation - here.elevation])
    return jnp.clip(change / scale, -1.0, 1.0)


def _view(state: State) -> View:
    episode: EpisodeState = state.pipeline_state  # pyright: ignore[reportAssignmentType] # brax lets any pytree stand here
    return episode.sight.view
