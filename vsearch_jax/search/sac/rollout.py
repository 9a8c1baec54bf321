"""The policy as a searcher: one episode."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from brax.envs.base import State
from jax import Array

from vsearch_jax.config import EnvConfig, SACConfig
from vsearch_jax.search.common import Record, add_generation, is_running, start_record, to_result
from vsearch_jax.search.sac.agent import act
from vsearch_jax.types import EpisodeState, SearchResult, View

StepFn = Callable[[State, Array], State]


def search(
    key: Array, start: State, step_fn: StepFn, actor: Any, config: SACConfig, env_config: EnvConfig
) -> tuple[SearchResult, State]:
    """Follows the policy until the threshold is met or the episode is out of steps.

    The policy acts by its mean. A mean policy that has not arrived after half of an episode's steps goes round in a
    circle, a little beside the target; from there on its actions are sampled, which breaks the circle.

    A step is one generation of one image; as a policy is measured by its episode length, the image of the start does
    not count. An episode is at least one step long, as in training, where the start may meet the threshold already.

    Args:
      key: PRNG key of the sampled actions.
      start: brax State of a started episode: `pipeline_state.sight.view`, `metrics["similarity"]` and
        `info["is_reachable"]` tell what was seen.
      step_fn: the environment's `step`, (state, action) -> state.
      actor: parameters of the policy.
      config: SACConfig that the policy was trained with.
      env_config: threshold and length of the episode.

    Returns:
      SearchResult with best_scores f32[episode_length], and the State at the end of the episode. Its `view` and `score`
      are those of the end, where the arm stands, not the best of the way.
    """
    record = start_record(_view(start), jnp.asarray(-jnp.inf, jnp.float32), env_config.episode_length)
    record = dataclasses.replace(record, evaluations=jnp.int32(0), unreachable=jnp.int32(0))
    threshold = jnp.asarray(env_config.threshold, jnp.float32)
    body = functools.partial(_step, key, step_fn, actor, config, threshold)
    record, end = jax.lax.while_loop(lambda carry: is_running(carry[0], threshold), body, (record, start))
    return dataclasses.replace(to_result(record), view=_view(end), score=end.metrics["similarity"]), end


def _step(
    key: Array, step_fn: StepFn, actor: Any, config: SACConfig, threshold: Array, carry: tuple[Record, State]
) -> tuple[Record, State]:
    record, state = carry
    observation: Array = state.obs  # pyright: ignore[reportAssignmentType] # brax allows dictionaries too
    sampled = act(jax.random.fold_in(key, record.generation), actor, observation, config)
    is_circling = record.generation >= record.best_scores.shape[0] // 2
    state = step_fn(state, jnp.where(is_circling, sampled, act(None, actor, observation, config)))
    score = jnp.where(state.info["is_reachable"] > 0.5, state.metrics["similarity"], -jnp.inf)
    views, scores = jax.tree.map(lambda x: x[None], (_view(state), score))
    return add_generation(record, views, scores, threshold), state


def _view(state: State) -> View:
    episode: EpisodeState = state.pipeline_state  # pyright: ignore[reportAssignmentType] # brax lets any pytree stand here
    return episode.sight.view
