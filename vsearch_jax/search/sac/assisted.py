"""The policy as a searcher, with a local search that helps where the policy stalls."""

from __future__ import annotations

import functools
import math

import flax.struct
import jax
import jax.numpy as jnp
from brax.envs.base import State
from jax import Array

from vsearch_jax.config import Config
from vsearch_jax.geometry import fold_into_band, wrap_angle
from vsearch_jax.search.common import Record, SearchArgs
from vsearch_jax.search.sac.policy import PolicyTask, Progress, StepFn, mean_action, present_view, run_episode
from vsearch_jax.types import SearchResult, View
from vsearch_jax.xla.tree import tree_where

# A step makes progress if it raises the best score by more than this.
_MIN_IMPROVEMENT = 3e-3
# A view with at least this score is near the target: about 10 degrees away at most.
_NEAR_SCORE = 0.9


@flax.struct.dataclass
class Help:
    """What the local search did in an episode.

    Attributes:
      num_stalled: i32[], number of steps before which the policy had stalled. With help, the local search chose them.
      num_around: i32[], number of the local search's steps around the present best view.
    """

    num_stalled: Array
    num_around: Array


def no_help() -> Help:
    """Returns the Help of an episode before its first step."""
    return Help(jnp.int32(0), jnp.int32(0))


def search(
    key: Array, step_fn: StepFn, args: SearchArgs[PolicyTask], config: Config, is_assisted: Array | bool = True
) -> tuple[SearchResult, Array]:
    """Searches for the target view with a trained policy in one episode. A local search helps where the policy stalls.

    In a few of 1000 episodes the policy would move in a circle, mostly near the target. There a local search chooses
    the step instead of the policy. It does so if the step before made no progress, and the best view is near the target
    or `config.evaluation.patience` steps are done. It also does so after a step that the arm could not do. The policy
    would repeat that step forever, because its action depends on its input only.

    The local search has two kinds of steps:

    - Near the target it tries views around the best view. The distance of these views from the best view is an estimate
      of the target's distance: 1 - score grows with the square of that distance. The direction of the target is
      unknown. Therefore the direction turns by 90 degrees in each step. After every 4 steps the distance grows.
    - Far from the target it moves around the object in one direction, with random elevations.

    All else is as in `policy.search`.

    Args:
      key: PRNG key of the local search.
      step_fn: the environment's `step`.
      args: the search problem. `task` holds the policy and the brax State at the start; `initial` is the view there.
      config: the run's config. Only `sac`, `env`, `evaluation.patience` and
        `encoder.threshold_angle_deg` are used.
      is_assisted: bool[]; if false, the policy is alone, and the result is that of `policy.search`.

    Returns:
      The result, as of `policy.search`; and i32[], the number of steps that the local search chose.
    """
    choose = functools.partial(choose_action, key, args, config, jnp.asarray(is_assisted))
    result, help_ = run_episode(step_fn, args, config, choose, no_help())
    return result, jnp.where(is_assisted, help_.num_stalled, 0)


def choose_action(
    key: Array, args: SearchArgs[PolicyTask], config: Config, is_assisted: Array, progress: Progress, help_: Help
) -> tuple[Array, Help]:
    """Chooses the action of the next step: the policy's, or the local search's where the policy has stalled.

    Args:
      key: PRNG key of the local search, equal in all steps of an episode.
      args: the search problem, as of `search`.
      config: the run's config, as of `search`.
      is_assisted: bool[]; if false, the action is always the policy's.
      progress: how far the episode is.
      help_: what the local search did so far.

    Returns:
      Action f32[2], and what the local search did after the step.
    """
    record, state = progress.record, progress.state
    num_steps = record.generation
    is_near = record.score >= _NEAR_SCORE
    # The first two steps count as progress, because there is no earlier score to compare with.
    has_improved = (num_steps < 2) | (record.score > record.best_scores[num_steps - 2] + _MIN_IMPROVEMENT)
    is_stalled = ~has_improved & ((num_steps >= config.evaluation.patience) | is_near)
    is_stalled = is_stalled | (state.info["is_reachable"] < 0.5)
    is_helped = is_assisted & is_stalled
    num_around = jnp.where(has_improved, 0, help_.num_around)

    # The keys are equal in every step, so that the first angle and the sweep's direction stay.
    around_key, sweep_key = jax.random.split(key)
    around = _view_around_best(around_key, record, num_around, args, config)
    sweep = _sweep_view(sweep_key, num_steps, state, args.band, config)
    towards = _action_towards(tree_where(is_near, around, sweep), state, config)
    action = jnp.where(is_helped, towards, mean_action(args.task.actor, state, config))
    return action, Help(
        num_stalled=help_.num_stalled + is_stalled.astype(jnp.int32),
        num_around=num_around + (is_helped & is_near).astype(jnp.int32),
    )


def _view_around_best(
    key: Array, record: Record, num_around: Array, args: SearchArgs[PolicyTask], config: Config
) -> View:
    """Returns the view around the best view that follows `num_around` (i32[]) others.

    The first four views lie on a circle, 90 degrees apart. Its radius is the estimated distance of the target. Each
    further circle is wider by this radius and turned by 45 degrees. The estimate takes the angle at which the pose loss
    wants the threshold. The codes of an autoencoder are less sharp, so its circles are too small.
    """
    missing = jnp.maximum(1.0 - record.score, 0.0) / (1.0 - args.threshold)
    quarters, circles = num_around.astype(jnp.float32), (num_around // 4).astype(jnp.float32)
    radius = math.radians(config.encoder.threshold_angle_deg) * jnp.sqrt(missing) * (1.0 + circles)
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
        azimuth=wrap_angle(present_view(state).azimuth + direction * math.radians(config.env.action_scale_deg)),
        elevation=jax.random.uniform(jax.random.fold_in(elevation_key, num_steps), (), jnp.float32, *band),
    )


def _action_towards(view: View, state: State, config: Config) -> Array:
    """Returns the action f32[2] that leads to `view`, or as close to it as one step can."""
    present = present_view(state)
    change = jnp.stack([wrap_angle(view.azimuth - present.azimuth), view.elevation - present.elevation])
    return jnp.clip(change / math.radians(config.env.action_scale_deg), -1.0, 1.0)
