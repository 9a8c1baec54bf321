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
    `config.evaluation.patience` steps goes round in a circle a little beside the target, or presses against the end of
    the band. From there on the steps are those of random search (SPEC.md 5): to a random view around the best one of
    the way, as near to it as a step leads.

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
    random_action = _random_action(jax.random.fold_in(key, record.generation), record, state, args.band, config)
    is_lost = record.generation >= config.evaluation.patience
    state = step_fn(state, jnp.where(is_lost, random_action, act(None, args.task.actor, observation, config.sac)))
    score = jnp.where(state.info["is_reachable"] > 0.5, state.metrics["similarity"], -jnp.inf)
    views, scores = jax.tree.map(lambda x: x[None], (_view(state), score))
    return add_generation(record, views, scores, args.threshold), state


def _random_action(key: Array, record: Record, state: State, band: Array, config: Config) -> Array:
    """Returns f32[2], the action to, or towards, a random view around the best one."""
    views = sample_around_best(key, record, band, config.random_search.k, 1)
    here, scale = _view(state), math.radians(config.env.action_scale_deg)
    change = jnp.stack([wrap_angle(views.azimuth[0] - here.azimuth), views.elevation[0] - here.elevation])
    return jnp.clip(change / scale, -1.0, 1.0)


def _view(state: State) -> View:
    episode: EpisodeState = state.pipeline_state  # pyright: ignore[reportAssignmentType] # brax lets any pytree stand here
    return episode.sight.view
