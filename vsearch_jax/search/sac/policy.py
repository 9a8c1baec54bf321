"""The policy as a searcher: one search is one episode, and each action is the policy's mean action."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import TypeVar

import flax.struct
import jax
import jax.numpy as jnp
from brax.envs.base import State
from flax import nnx
from jax import Array

from vsearch_jax.config import Config
from vsearch_jax.env import episode_of, obs_of
from vsearch_jax.search.common import Record, SearchArgs, add_generation, is_running, start_record, to_result
from vsearch_jax.search.sac.agent import act
from vsearch_jax.types import PolicyEnd, SearchResult, View

Memory = TypeVar("Memory")

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
class Progress:
    """How far an episode is.

    Attributes:
      record: what the search has found. A generation is one step.
      state: brax State.
      costs: f32[2], travel in rad and duration in s, summed over the motions so far.
    """

    record: Record
    state: State
    costs: Array


ChooseAction = Callable[[Progress, Memory], tuple[Array, Memory]]
"""`choose(progress, memory) -> (action f32[2], memory)`: the action of the next step. `memory` is any pytree."""


def search(key: Array, step_fn: StepFn, args: SearchArgs[PolicyTask], config: Config) -> SearchResult:
    """Searches for the target view with a trained policy in one episode. The policy takes its mean action.

    The episode ends when the similarity meets the threshold or after `config.env.episode_length` steps. Each step takes
    one image. The image of the initial view is not counted, because the result of a policy is its number of steps. An
    episode has at least one step, even if the initial view meets the threshold, as in training.

    Args:
      key: not used; the mean action is not random.
      step_fn: the environment's `step`.
      args: the search problem. `task` holds the policy and the brax State at the start; `initial` is the view there.
      config: the run's config. Only `sac` and `env` are used.

    Returns:
      Last view of the episode (not the best one), its score, and the number of steps. best_scores is
      f32[episode_length]. `end` holds the last brax State and the cost of the motions.
    """
    del key

    def choose_mean(progress: Progress, memory: None) -> tuple[Array, None]:
        return mean_action(args.task.actor, progress.state, config), memory

    return run_episode(step_fn, args, config, choose_mean, None)[0]


def mean_action(actor: nnx.State, state: State, config: Config) -> Array:
    """Returns the deterministic action (tanh of the mean) that a policy takes in a brax State.

    Args:
      actor: parameters of the policy.
      state: brax State of one episode.
      config: the run's config; `sac` is read.

    Returns:
      Action f32[2] in [-1, 1]: change of azimuth and elevation in units of `env.action_scale_deg`.
    """
    return act(None, actor, obs_of(state), config.sac)


def run_episode(
    step_fn: StepFn, args: SearchArgs[PolicyTask], config: Config, choose: ChooseAction[Memory], memory: Memory
) -> tuple[SearchResult, Memory]:
    """Runs one episode to its end.

    Args:
      step_fn: the environment's `step`.
      args: the search problem, as of `search`.
      config: the run's config; the length of the episode is read.
      choose: chooses the action of each step.
      memory: what `choose` gets in the first step, any pytree.

    Returns:
      The result, as of `search`, and what `choose` last returned as its memory.
    """
    body = functools.partial(run_step, step_fn, args, choose)
    progress, memory = jax.lax.while_loop(
        lambda loop: is_running(loop[0].record, args.threshold), body, (start_progress(args, config), memory)
    )
    return episode_result(progress), memory


def start_progress(args: SearchArgs[PolicyTask], config: Config) -> Progress:
    """Returns the progress of an episode before its first step.

    Args:
      args: the search problem, as of `search`.
      config: the run's config; the length of the episode is read.
    """
    record = start_record(args.initial, jnp.asarray(-jnp.inf, jnp.float32), config.env.episode_length)
    record = dataclasses.replace(record, evaluations=jnp.int32(0), unreachable=jnp.int32(0))
    return Progress(record=record, state=args.task.start, costs=jnp.zeros(2))


def episode_result(progress: Progress) -> SearchResult:
    """Returns the result of an episode, as of `search`, from its progress at the end."""
    state = progress.state
    result = to_result(progress.record)
    score, end = state.metrics["similarity"], PolicyEnd(state, *progress.costs)
    return dataclasses.replace(result, view=present_view(state), score=score, end=end)


def run_step(
    step_fn: StepFn, args: SearchArgs[PolicyTask], choose: ChooseAction[Memory], loop: tuple[Progress, Memory]
) -> tuple[Progress, Memory]:
    """Runs one step of an episode that has not ended.

    Args:
      step_fn: the environment's `step`.
      args: the search problem, as of `search`.
      choose: chooses the action.
      loop: the progress, and the memory of `choose`.

    Returns:
      The progress after the step, and what `choose` returned as its memory.
    """
    progress, memory = loop
    action, memory = choose(progress, memory)
    state = step_fn(progress.state, action)
    score = jnp.where(state.info["is_reachable"] > 0.5, state.metrics["similarity"], -jnp.inf)
    views, scores = jax.tree.map(lambda x: x[None], (present_view(state), score))
    costs = jnp.stack([state.metrics["joint_travel"], state.metrics["motion_time"]])
    record = add_generation(progress.record, views, scores, args.threshold)
    return Progress(record=record, state=state, costs=progress.costs + costs), memory


def present_view(state: State) -> View:
    """Returns the view of a brax State: where the camera is."""
    return episode_of(state).observation.view
