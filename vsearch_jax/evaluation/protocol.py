"""The whole protocol as one jitted function."""

from __future__ import annotations

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.core import Tracer

from vsearch_jax.config import Config
from vsearch_jax.env import UnreachableError, ViewSearchEnv, check_band
from vsearch_jax.evaluation.episodes import episode_keys, evaluate_policies
from vsearch_jax.evaluation.outcome import measure_outcome
from vsearch_jax.evaluation.step_bound import band_grid
from vsearch_jax.evaluation.trials import search_trials
from vsearch_jax.evaluation.views import ViewRequest, initial_views, observe_request, protocol_target
from vsearch_jax.geometry import cosine_similarity
from vsearch_jax.search import cma_es, random_search
from vsearch_jax.types import Observation, ReachabilityMap, TrainState
from vsearch_jax.xla.batching import map_in_batches


def evaluate(state: TrainState, config: Config) -> dict[str, Any]:
    """Runs the whole protocol; deterministic for a state and config.

    Args:
      state: a trained state.
      config: the config it was trained with; `config.evaluation` may differ, and in `config.env` what counts as
        reachable and how the arm moves.

    Returns:
      For `random_search` and `cma_es` arrays of [trials] (`num_runs` runs of each initial view, runs fastest), for
      `sac` of [seeds, episodes]: `is_success` bool, `evaluations` i32, `final_cosine` f32, `rotation_error` f32 rad,
      `frobenius_angle` f32 rad, `translation_error` f32 m, `is_false_positive` bool, `unreachable` i32,
      `best_scores` f32[..., G], `joint_travel` f32 rad and `motion_time` f32 s of all motions together, `num_plans`
      i32, how many motions were asked for, one an image but that of the initial view; `initial_view` and `target_view`
      View of f32 rad; for `sac` also `steps_lower_bound` i32, fewer steps than which no policy needs, and `num_helped`
      i32, steps that were not the policy's.

    Raises:
      ConfigError: the arm can't reach the target view, or nothing at every azimuth.
    """
    check_target(state.reach, config)
    return _evaluate(state, config)


def check_target(reach: ReachabilityMap, config: Config) -> None:
    """Checks that there is a reachable band and that the target view of random search and CMA-ES lies in it.

    Does nothing under a trace, where the band is not known.

    Raises:
      ConfigError: the arm reaches no elevation at every azimuth, or not the target's.
    """
    if isinstance(reach.band, Tracer):
        return
    check_band(reach, config)
    low, high = np.rad2deg(np.asarray(reach.band))
    elevation = config.evaluation.target_elevation_deg
    if not low - 1e-3 <= elevation <= high + 1e-3:
        raise UnreachableError(
            f"EvaluationConfig.target_elevation_deg is {elevation:g}, which the arm cannot reach at every azimuth; "
            f"allowed with this arm, mount and object: {low:.1f} to {high:.1f}",
            reach,
        )


@functools.partial(jax.jit, static_argnames="config")
def _evaluate(state: TrainState, config: Config) -> dict[str, Any]:
    env = ViewSearchEnv(config, state.encoder, state.reach)
    key = jax.random.fold_in(state.key, 2**31 - 1)  # a salt that training does not use
    survey_key, random_search_key, cma_es_key, sac_key = jax.random.split(key, 4)

    reset_keys, search_keys = episode_keys(sac_key, config)
    initial, grid, target, ends = observe_known_views(survey_key, reset_keys, env, config)
    similarity = jax.vmap(cosine_similarity, in_axes=(0, None))(initial.code, target.code)
    # A view that is not reached has a code of zeros.
    starts = (initial, jnp.where(jnp.any(initial.code != 0.0, axis=-1), similarity, -jnp.inf))

    methods = (random_search.method(config.random_search), cma_es.method(config.cma_es))
    results = search_trials(jnp.stack([random_search_key, cma_es_key]), env, methods, starts, target)
    target_views = jax.tree.map(lambda x: jnp.broadcast_to(x, starts[1].shape), target.view)
    outcomes: dict[str, Any] = {}
    for name, (result, motions, camera) in zip(("random_search", "cma_es"), results, strict=True):
        measured = jax.vmap(measure_outcome, in_axes=(None, 0, 0, None))(config, result, camera, target.camera)
        outcomes[name] = measured | motions | {"initial_view": initial.view, "target_view": target_views}
    return outcomes | {"sac": evaluate_policies(env, state, (search_keys, ends), grid)}


def observe_known_views(
    key: Array, reset_keys: Array, env: ViewSearchEnv, config: Config
) -> tuple[Observation, Observation, Observation, Observation]:
    """Looks at all views that are known beforehand, in one place: each more would be compiled anew.

    Args:
      key: PRNG key of the joints with which the protocol's views are looked at.
      reset_keys: PRNG keys of the policies' initial views and targets, any shape.
      env: the task.
      config: number of initial views and runs, target.

    Returns:
      Observations of the trials' initial views [N], of a grid over the band, of the target, and for each of `reset_keys`.
    """
    views = jax.tree.map(lambda x: jnp.repeat(x, config.evaluation.num_runs), initial_views(config, env.reach.band))
    grid, target = band_grid(env.reach.band), jax.tree.map(lambda x: x[None], protocol_target(config))
    fixed = jax.tree.map(lambda *x: jnp.concatenate(x), views, grid, target)
    keys = jax.random.split(key, fixed.azimuth.shape[0])
    asked = (
        ViewRequest(fixed, jax.vmap(env.random_joints)(keys), jnp.ones(keys.shape, bool)),
        ViewRequest(*jax.vmap(env.random_view)(reset_keys.reshape(-1)), jnp.zeros(reset_keys.size, bool)),
    )
    asked = jax.tree.map(lambda *x: jnp.concatenate(x), *asked)
    observations = map_in_batches(functools.partial(observe_request, env), asked, config.evaluation.batch_size)
    num_trials, num_fixed = views.azimuth.shape[0], keys.shape[0]
    parts = (slice(num_trials), slice(num_trials, num_fixed - 1), num_fixed - 1, slice(num_fixed, None))
    initial, seen_grid, seen_target, ends = (jax.tree.map(lambda x, n=n: x[n], observations) for n in parts)
    ends = jax.tree.map(lambda x: x.reshape(*reset_keys.shape, *x.shape[1:]), ends)
    return initial, seen_grid, seen_target, ends
