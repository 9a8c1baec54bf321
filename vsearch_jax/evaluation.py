"""The thesis's protocol (SPEC.md 4-7) for every searcher as one jitted function of batched trials."""

from __future__ import annotations

import functools
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from vsearch_jax.config import Config, ConfigError
from vsearch_jax.env import ViewSearchEnv, pose_error
from vsearch_jax.geometry import angle_difference, cosine_similarity, wrap_angle
from vsearch_jax.planning import nearest_cell
from vsearch_jax.search import SearchArgs, cma_es, random_search, sac
from vsearch_jax.types import ReachabilityMap, SearchResult, Sight, TrainState, View

FALSE_POSITIVE_DEG = 10.0
"""A found view whose rotation is further than this from the target's is a false positive (SPEC.md 4)."""
GRID_AZIMUTHS, GRID_ELEVATIONS = 144, 13
"""Views on which the lower bound of an episode's steps looks for the threshold: every 2.5 degrees."""


def evaluate(state: TrainState, config: Config) -> dict[str, Any]:
    """Runs the whole protocol; deterministic for a state and config.

    Args:
      state: a trained state.
      config: the config it was trained with; `config.evaluation` may differ.

    Returns:
      For `random_search` and `cma_es` arrays of [trials] (`num_runs` runs of each initial view, runs fastest), for
      `sac` of [seeds, episodes]: `is_success` bool, `evaluations` i32, `final_cosine` f32, `rotation_error` f32 rad,
      `frobenius_angle` f32 rad, `translation_error` f32 m, `is_false_positive` bool, `unreachable` i32,
      `best_scores` f32[..., G], `initial_view` and `target_view` View of f32 rad; for `sac` also
      `steps_lower_bound` i32: no policy needs fewer steps.

    Raises:
      ConfigError: the arm can't reach the target view, or nothing at every azimuth.
    """
    check_target(state.reach, config)
    return _evaluate(state, config)


def check_target(reach: ReachabilityMap, config: Config) -> None:
    """Checks that there is a reachable band and that the target view of random search and CMA-ES lies in it.

    Raises:
      ConfigError: the arm reaches no elevation at every azimuth, or not the target's.
    """
    low, high = np.rad2deg(np.asarray(reach.band))
    if np.isnan(low):
        raise ConfigError(
            f"arm {config.scene.arm!r} at SceneConfig.mount_height {config.scene.mount_height:g} reaches no elevation "
            f"at every azimuth around object {config.scene.object!r}; try another mount_height or radius"
        )
    elevation = config.evaluation.target_elevation_deg
    if not low - 1e-3 <= elevation <= high + 1e-3:
        raise ConfigError(
            f"EvaluationConfig.target_elevation_deg is {elevation:g}, which the arm cannot reach at every azimuth; "
            f"allowed with this arm, mount and object: {low:.1f} to {high:.1f}"
        )


@functools.partial(jax.jit, static_argnames="config")
def _evaluate(state: TrainState, config: Config) -> dict[str, Any]:
    env = ViewSearchEnv(config, state.encoder, state.reach)
    key = jax.random.fold_in(state.key, 2**31 - 1)  # a salt that training does not use
    return {
        "random_search": evaluate_search(jax.random.fold_in(key, 0), env, random_search.search, config.random_search),
        "cma_es": evaluate_search(jax.random.fold_in(key, 1), env, cma_es.search, config.cma_es),
        "sac": evaluate_policies(jax.random.fold_in(key, 2), env, state),
    }


def initial_views(config: Config, band: Array) -> View:
    """Returns View of f32[num_initial_views]: even in azimuth, elevations spread over the band.

    Azimuths lie half a spacing off the axes, equally many in each quadrant; elevations step through 1/6, 3/6 and 5/6 of
    the band (f32[2] rad).
    """
    number = jnp.arange(config.evaluation.num_initial_views)
    azimuth = wrap_angle((number + 0.5) * (2.0 * jnp.pi / config.evaluation.num_initial_views))
    return View(azimuth, band[0] + (band[1] - band[0]) * (2.0 * (number % 3) + 1.0) / 6.0)


def evaluate_search(key: Array, env: ViewSearchEnv, search: Any, search_config: Any) -> dict[str, Any]:
    """Runs `search` from every initial view, several times each; see `evaluate` for the result."""
    settings = env.config.evaluation
    views = initial_views(env.config, env.reach.band)
    views = jax.tree.map(lambda x: jnp.repeat(x, settings.num_runs), views)
    target_key, trials_key = jax.random.split(key)
    target, _ = env.look(protocol_target(env.config), env.random_joints(target_key))
    run = functools.partial(run_trial, env=env, target=target, search=search, search_config=search_config)
    keys = jax.random.split(trials_key, views.azimuth.shape[0])
    samples = getattr(search_config, "num_samples", None) or search_config.population
    return jax.lax.map(lambda xs: run(*xs), (keys, views), batch_size=max(1, settings.batch_size // samples))


def run_trial(
    key: Array, view: View, *, env: ViewSearchEnv, target: Sight, search: Any, search_config: Any
) -> dict[str, Any]:
    """Runs one search from `view` and measures where it ended."""
    joints_key, search_key = jax.random.split(key)
    initial, _ = env.look(view, env.random_joints(joints_key))
    args = SearchArgs(
        initial=initial.view,
        band=env.reach.band,
        threshold=jnp.asarray(env.config.env.threshold),
        task=(initial.qpos, target.code),
    )
    result: SearchResult = search(search_key, functools.partial(score_view, env), args, search_config)
    final, _ = env.look(result.view, initial.qpos)
    return outcome(env, final, target, result) | {"initial_view": initial.view, "target_view": target.view}


def score_view(env: ViewSearchEnv, view: View, task: tuple[Array, Array]) -> Array:
    """Returns f32[], the cosine of `view` with the target code; -inf where the arm can't reach it.

    Args:
      env: the task.
      view: View of f32[] rad.
      task: joints f32[nq] from which the arm comes, target code f32[Z].
    """
    qpos, target_code = task
    sight, is_reachable = env.look(view, qpos)
    return jnp.where(is_reachable, cosine_similarity(sight.code, target_code), -jnp.inf)


def outcome(env: ViewSearchEnv, final: Sight, target: Sight, result: SearchResult) -> dict[str, Any]:
    """Returns the measures of a search that ended at `final`."""
    rotation, frobenius, translation = pose_error(final.camera, target.camera)
    is_success = result.score >= env.config.env.threshold
    return {
        "is_success": is_success,
        "evaluations": result.evaluations,
        "final_cosine": result.score,
        "rotation_error": rotation,
        "frobenius_angle": frobenius,
        "translation_error": translation,
        "is_false_positive": is_success & (rotation > math.radians(FALSE_POSITIVE_DEG)),
        "unreachable": result.unreachable,
        "best_scores": result.best_scores,
    }


def evaluate_policies(key: Array, env: ViewSearchEnv, state: TrainState) -> dict[str, Any]:
    """Runs `num_episodes` episodes of every policy, initial views and targets random; see `evaluate` for the result."""
    settings = env.config.evaluation
    grid = band_grid(env)
    seeds = jnp.arange(env.config.sac.num_seeds)

    def one_policy(xs: tuple[Array, Any]) -> dict[str, Any]:
        seed, actor = xs
        keys = jax.random.split(jax.random.fold_in(key, seed), settings.num_episodes)
        run = functools.partial(run_episode, env=env, actor=actor, grid=grid)
        return jax.lax.map(run, keys, batch_size=settings.batch_size)

    return jax.lax.map(one_policy, (seeds, state.sac.actor))


def run_episode(key: Array, *, env: ViewSearchEnv, actor: Any, grid: Sight) -> dict[str, Any]:
    """Runs one episode of a policy and measures where it ended."""
    reset_key, search_key = jax.random.split(key)
    start = env.reset(reset_key)
    result, end = sac.search(search_key, start, env.step, actor, env.config.sac, env.config.env)
    first, last = start.pipeline_state, end.pipeline_state
    return outcome(env, last.sight, last.target, result) | {
        "initial_view": first.sight.view,
        "target_view": first.target.view,
        "steps_lower_bound": steps_lower_bound(first.sight.view, first.target, grid, env.reach.band, env.config),
    }


def band_grid(env: ViewSearchEnv) -> Sight:
    """Returns Sight of f32[N, ...]: the reachable band on a grid, each view with the arm in some configuration."""
    azimuths = jnp.linspace(-jnp.pi, jnp.pi, GRID_AZIMUTHS, endpoint=False)
    elevations = jnp.linspace(env.reach.band[0], env.reach.band[1], GRID_ELEVATIONS)
    views = View(*(x.reshape(-1) for x in jnp.meshgrid(azimuths, elevations)))
    look = functools.partial(_look_from_map, env)
    return jax.lax.map(look, views, batch_size=env.config.evaluation.batch_size)


def _look_from_map(env: ViewSearchEnv, view: View) -> Sight:
    sight, _ = env.look(view, env.reach.qpos[nearest_cell(env.reach, view)])
    return sight


def steps_lower_bound(initial: View, target: Sight, grid: Sight, band: Array, config: Config) -> Array:
    """Returns i32[], fewer steps than which no policy can need: a bound for one episode.

    A step changes azimuth and elevation by at most `action_scale_deg` each. The episode ends at the nearest view that
    meets the threshold, which need not be the target; it lies within half a spacing of one of the `grid`'s views.

    Args:
      initial: View of f32[] rad.
      target: Sight of the target.
      grid: Sight of f32[N, ...], from `band_grid`.
      band: f32[2] rad, the elevations that `grid` spans.
      config: the run's.
    """
    half_azimuth = jnp.pi / GRID_AZIMUTHS
    half_elevation = 0.5 * (band[1] - band[0]) / (GRID_ELEVATIONS - 1)
    azimuth = jnp.abs(angle_difference(grid.view.azimuth, initial.azimuth)) - half_azimuth
    elevation = jnp.abs(grid.view.elevation - initial.elevation) - half_elevation
    is_found = cosine_similarity(grid.code, target.code) >= config.env.threshold
    to_grid = jnp.where(is_found, jnp.maximum(azimuth, elevation), jnp.inf).min()
    to_target = jnp.maximum(
        jnp.abs(angle_difference(target.view.azimuth, initial.azimuth)),
        jnp.abs(target.view.elevation - initial.elevation),
    )
    steps = jnp.minimum(to_grid, to_target) / math.radians(config.env.action_scale_deg)
    return jnp.maximum(jnp.ceil(steps - 1e-5), 1.0).astype(jnp.int32)


@functools.partial(jax.jit, static_argnames="config")
def record_search(state: TrainState, config: Config) -> dict[str, Array]:
    """Returns one search of the first policy in pictures: from the far side of the object to the protocol's target.

    Returns:
      `images` f32[T + 1, H, W, 3], start first, T = `episode_length`; `similarity` f32[T + 1]; `target` f32[H, W, 3];
      `num_steps` i32[], after which the rest repeats.
    """
    env = ViewSearchEnv(config, state.encoder, state.reach)
    actor = jax.tree.map(lambda x: x[0], state.sac.actor)
    initial_key, target_key = jax.random.split(state.key)
    target_view = protocol_target(config)
    far_side = View(wrap_angle(target_view.azimuth + math.radians(165.0)), jnp.mean(env.reach.band))
    initial, _ = env.look(far_side, env.random_joints(initial_key))
    target, _ = env.look(target_view, env.random_joints(target_key))
    start = env.start(initial, target)

    def step(state: Any, _: None) -> tuple[Any, Any]:
        moved = env.step(state, sac.act(None, actor, state.obs, config.sac))
        moved = jax.tree.map(lambda new, old: jnp.where(state.done > 0, old, new), moved, state)
        return moved, moved

    _, states = jax.lax.scan(step, start, length=config.env.episode_length)
    states = jax.tree.map(lambda first, rest: jnp.concatenate([first[None], rest]), start, states)
    return {
        "images": jax.lax.map(lambda qpos: env.picture(qpos)[1].rgb, states.pipeline_state.sight.qpos),
        "similarity": states.metrics["similarity"],
        "target": env.picture(target.qpos)[1].rgb,
        "num_steps": states.pipeline_state.num_steps[-1],
    }


def protocol_target(config: Config) -> View:
    """Returns the target view of random search and CMA-ES, f32[] rad."""
    settings = config.evaluation
    return View(wrap_angle(jnp.deg2rad(settings.target_azimuth_deg)), jnp.deg2rad(settings.target_elevation_deg))
