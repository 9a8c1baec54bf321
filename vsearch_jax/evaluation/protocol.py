"""The protocol of all searchers as one jitted function."""

from __future__ import annotations

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.core import Tracer

from vsearch_jax.config import Config
from vsearch_jax.env import UnreachableError, ViewSearchEnv, check_band, protocol_target
from vsearch_jax.evaluation.episodes import episode_keys, evaluate_policies
from vsearch_jax.evaluation.outcome import Outcome
from vsearch_jax.evaluation.step_bound import band_grid
from vsearch_jax.evaluation.trials import search_trials
from vsearch_jax.evaluation.views import SeenView, ViewRequest, initial_views, observe_request
from vsearch_jax.search import BLACK_BOX
from vsearch_jax.types import Observation, ReachabilityMap, TrainState
from vsearch_jax.xla.batching import map_in_batches


def evaluate(state: TrainState, config: Config) -> dict[str, Outcome]:
    """Evaluates all searchers of a trained run by the thesis's protocol: runs every search, and measures each.

    The result depends on `state` and `config` only.

    Args:
      state: a trained state.
      config: the config of the training. `evaluation` may differ. In `env`, `reachable` and `motion` may differ.

    Returns:
      Measures by name, for each searcher of `vsearch_jax.search.LABELS`. For black-box searchers arrays of [trials]; a
      trial is one search. Each initial view has `num_runs` trials in a row. For `sac` (the policies alone) and
      `sac_assisted` (the same episodes with a local search) arrays of [policy seeds, episodes]. The arrays:

      - `is_success` bool: the final cosine meets the threshold.
      - `evaluations` i32: images taken.
      - `final_cosine` f32.
      - `rotation_error` f32 rad, geodesic; `frobenius_angle` f32 rad, formula 3.2 of the thesis.
      - `translation_error` f32 m.
      - `surface_distance` f32 m: largest distance between a point of the object in the frames of the final camera and
        of the target camera (MSSD of the BOP benchmark).
      - `is_false_positive` bool: a success whose rotation error is above `FALSE_POSITIVE_DEG`.
      - `unreachable` i32: images that the arm could not take.
      - `best_scores` f32[..., G]: best score after each of G generations (images that a searcher asks for at once).
      - `joint_travel` f32 rad and `motion_time` f32 s, sums over all motions.
      - `num_plans` i32: motions requested. Each image but that of the initial view needs one.
      - `initial_view` and `target_view`: View of f32 rad.
      - `final_qpos` and `target_qpos` f32[..., nq] rad or m: joints at the view that the search ends with, which is the
        best one of a black-box search; and joints from which the target image was taken.
      - `num_wide` i32 of `random_search`: how often a wide sample became the best view.
      - `num_restarts` and `scan_images` i32 of `cma_es_restarts`: restarts, and images taken by scans.
      - `unreachable_by_generation` i32[..., G] of both forms of CMA-ES: samples that the arm could not reach.
      - `steps_lower_bound` i32 of the policies, see `steps_lower_bound`.
      - `num_helped` i32 of `sac_assisted`: steps that the local search chose.

    Raises:
      UnreachableError: the arm cannot reach the target view, or reaches no elevation at every azimuth.
    """
    check_target(state.reach, config)
    outcomes, is_target_reached = _evaluate(state, config)
    settings = config.evaluation
    check_reached(is_target_reached, (settings.target_azimuth_deg, settings.target_elevation_deg), state.reach)
    return outcomes


def check_reached(is_reached: Array, target_deg: tuple[float, float], reach: ReachabilityMap) -> None:
    """Checks that inverse kinematics brought the camera to the target view.

    Inside the band it rarely fails: between the views of the reachability map. Does nothing while JAX traces, because
    values are unknown then.

    Args:
      is_reached: bool[], the camera was at the target view.
      target_deg: azimuth and elevation of the target view in degrees, for the error message.
      reach: the views that the arm reaches.

    Raises:
      UnreachableError: the camera was not at the target view.
    """
    if not isinstance(is_reached, Tracer) and not bool(is_reached):
        raise UnreachableError(
            f"inverse kinematics finds no joints for the target view at EvaluationConfig.target_azimuth_deg "
            f"{target_deg[0]:g} and EvaluationConfig.target_elevation_deg {target_deg[1]:g}, although the arm reaches "
            "views around it; evaluate with another target, for example one degree away",
            reach,
        )


def check_target(reach: ReachabilityMap, config: Config) -> None:
    """Checks that the reachable band exists and holds the target view of random search and CMA-ES.

    The band is the range of elevations that the arm reaches at every azimuth. Does nothing while JAX traces, because
    values are unknown then.

    Args:
      reach: the views that the arm reaches.
      config: the run's config.

    Raises:
      ConfigError: the arm reaches no elevation at every azimuth, or not the target's elevation.
    """
    if isinstance(reach.band, Tracer):
        return
    check_band(reach, config)
    low, high = np.rad2deg(np.asarray(reach.band))
    elevation = config.evaluation.target_elevation_deg
    if not low - 1e-3 <= elevation <= high + 1e-3:
        raise UnreachableError(
            f"EvaluationConfig.target_elevation_deg is {elevation:g}, which the arm cannot reach at every azimuth; "
            f"allowed with this arm, mount and object: {low:.1f} to {high:.1f}. Set it in this "
            "range, or set another SceneConfig.mount_height",
            reach,
        )


@functools.partial(jax.jit, static_argnames="config")
def _evaluate(state: TrainState, config: Config) -> tuple[dict[str, Outcome], Array]:
    """Returns the measures of all searchers; and bool[], whether the camera was at the target view."""
    env = ViewSearchEnv(config, state.encoder, state.reach)
    key = jax.random.fold_in(state.key, 2**31 - 1)  # a salt that training does not use
    known_views_key, search_key, policy_key = jax.random.split(key, 3)

    reset_keys, search_keys = episode_keys(policy_key, config)
    initial, grid, target, ends = observe_known_views(known_views_key, reset_keys, env, config)
    methods = tuple(build(config) for build in BLACK_BOX.values())
    trials = search_trials(jax.random.split(search_key, len(methods)), env, methods, initial, target.observation)
    outcomes = dict(zip(BLACK_BOX, trials, strict=True))
    return outcomes | evaluate_policies(env, state, (search_keys, ends), grid), target.is_reached


class KnownViews(NamedTuple):
    """What the camera sees from the views that are known before the searches start.

    Attributes:
      initial: from the initial views of the N trials (searches), arrays [N, ...].
      grid: from the P views of `band_grid`, arrays [P, ...].
      target: from the target view of random search and CMA-ES.
      ends: Observation from initial and target views of the policies' episodes; the axes of the reset keys lead.
    """

    initial: SeenView
    grid: SeenView
    target: SeenView
    ends: Observation


def observe_known_views(key: Array, reset_keys: Array, env: ViewSearchEnv, config: Config) -> KnownViews:
    """Takes the images of all views that are known before the searches start, in one batched call.

    One call for all views saves compile time: XLA compiles the renderer anew for each call.

    Args:
      key: PRNG key of the preferred joint values at the protocol's views.
      reset_keys: PRNG keys of the initial and target views of the policies' episodes, any shape.
      env: the task.
      config: the run's config; `evaluation` is read.

    Returns:
      What the camera sees from these views. The axes of `ends` start with the shape of `reset_keys`.
    """
    views = jax.tree.map(lambda x: jnp.repeat(x, config.evaluation.num_runs), initial_views(config, env.reach.band))
    grid, target = band_grid(env.reach.band), jax.tree.map(lambda x: x[None], protocol_target(config))
    fixed = jax.tree.map(lambda *x: jnp.concatenate(x), views, grid, target)
    keys = jax.random.split(key, fixed.azimuth.shape[0])
    requests = (
        ViewRequest(fixed, jax.vmap(env.random_joints)(keys), jnp.ones(keys.shape, bool)),
        ViewRequest(*jax.vmap(env.random_view)(reset_keys.reshape(-1)), jnp.zeros(reset_keys.size, bool)),
    )
    requests = jax.tree.map(lambda *x: jnp.concatenate(x), *requests)
    seen = map_in_batches(functools.partial(observe_request, env), requests, config.evaluation.batch_size)
    num_trials, num_fixed = views.azimuth.shape[0], keys.shape[0]
    parts = (slice(num_trials), slice(num_trials, num_fixed - 1), num_fixed - 1, slice(num_fixed, None))
    known = [jax.tree.map(lambda x, part=part: x[part], seen) for part in parts]
    initial, grid, target = known[:3]
    ends = jax.tree.map(lambda x: x.reshape(*reset_keys.shape, *x.shape[1:]), known[3].observation)
    if config.env.target == "fixed":
        ends = jax.tree.map(
            lambda x, target: x.at[..., 1, *[slice(None)] * target.ndim].set(target), ends, target.observation
        )
    return KnownViews(initial, grid, target, ends)
