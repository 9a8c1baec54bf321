"""The thesis's protocol (thesis, chapters 3.6 to 4.3) for every searcher as one jitted function of batched trials."""

from __future__ import annotations

import functools
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from vsearch_jax.bound import band_grid, steps_lower_bound
from vsearch_jax.config import Config, ConfigError, RandomSearchConfig
from vsearch_jax.env import ViewSearchEnv, check_band, episode_of, pose_error
from vsearch_jax.geometry import cosine_similarity, wrap_angle
from vsearch_jax.search import SearchArgs, cma_es, random_search, sac
from vsearch_jax.types import Camera, ReachabilityMap, SearchResult, Sight, TrainState, View

FALSE_POSITIVE_DEG = 10.0
"""A found view whose rotation is further than this from the target's is a false positive (thesis 3.6)."""


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
      `steps_lower_bound` i32, fewer steps than which no policy needs, and `num_helped` i32, steps that were not the
      policy's.

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
    check_band(reach, config)
    low, high = np.rad2deg(np.asarray(reach.band))
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
    survey_key, random_search_key, cma_es_key, sac_key = jax.random.split(key, 4)

    # All views known beforehand are looked at in one place: each more would be compiled anew.
    views = jax.tree.map(lambda x: jnp.repeat(x, config.evaluation.num_runs), initial_views(config, env.reach.band))
    num_trials = views.azimuth.shape[0]
    known = (views, band_grid(env.reach.band), jax.tree.map(lambda x: x[None], protocol_target(config)))
    known = jax.tree.map(lambda *x: jnp.concatenate(x), *known)
    keys = jax.random.split(survey_key, known.azimuth.shape[0])
    look = functools.partial(look_from_anywhere, env)
    sights, is_reachable = map_batched(look, (keys, known), config.evaluation.batch_size)
    # A code that nothing matches stands for a view that is not reached.
    code = jnp.where(is_reachable[:, None], sights.code, 0.0)
    sights = sights.replace(code=code)  # pyright: ignore[reportAttributeAccessIssue] # flax adds it
    initial, grid, target = (jax.tree.map(lambda x, n=n: x[n], sights) for n in _split(num_trials))
    similarity = jax.vmap(cosine_similarity, in_axes=(0, None))(initial.code, target.code)
    starts = (initial, jnp.where(is_reachable[:num_trials], similarity, -jnp.inf))

    results = {
        "random_search": search_trials(
            random_search_key, env, (random_search.search, config.random_search), starts, target
        ),
        "cma_es": search_trials(cma_es_key, env, (cma_es.search, config.cma_es), starts, target),
    }
    ends = jax.tree.map(lambda *x: jnp.concatenate(x), *(result.view for result in results.values()))
    cameras = jax.vmap(functools.partial(camera_at, env))(ends, jnp.tile(initial.qpos, (len(results), 1)))
    outcomes: dict[str, Any] = {}
    for number, (name, result) in enumerate(results.items()):
        camera = jax.tree.map(lambda x, n=number: x[n * num_trials : (n + 1) * num_trials], cameras)
        measured = jax.vmap(outcome, in_axes=(None, 0, 0, None))(config, result, camera, target.camera)
        target_views = jax.tree.map(lambda x: jnp.broadcast_to(x, (num_trials,)), target.view)
        outcomes[name] = measured | {"initial_view": initial.view, "target_view": target_views}
    return outcomes | {"sac": evaluate_policies(sac_key, env, state, grid)}


def _split(num_trials: int) -> tuple[slice, slice, int]:
    return slice(num_trials), slice(num_trials, -1), -1


def map_batched(function: Any, xs: Any, batch_size: int) -> Any:
    """Returns `function` over the leading axis of `xs`, `batch_size` items at a time.

    Unlike `jax.lax.map` it compiles `function` once also where batches do not come out even: the last item is repeated.
    """
    count = jax.tree.leaves(xs)[0].shape[0]
    batch_size = min(batch_size, count)
    index = jnp.minimum(jnp.arange(count + -count % batch_size), count - 1)
    results = jax.lax.map(function, jax.tree.map(lambda x: x[index], xs), batch_size=batch_size)
    return jax.tree.map(lambda x: x[:count], results)


def look_from_anywhere(env: ViewSearchEnv, item: tuple[Array, View]) -> tuple[Sight, Array]:
    """Returns what is seen from a view with joints near random ones, however they are come by, and bool[] is_reachable.

    Args:
      env: the task.
      item: PRNG key and View of f32[] rad.
    """
    key, view = item
    qpos, is_reachable = env.solve(view, env.random_joints(key))
    return env.see(view, qpos), is_reachable


def camera_at(env: ViewSearchEnv, view: View, qpos: Array) -> Camera:
    """Returns the wrist camera where the arm, coming from joints `qpos` (f32[nq]), reaches `view`."""
    joints, _ = env.solve(view, qpos)
    return env.stand(joints)[1]


def initial_views(config: Config, band: Array) -> View:
    """Returns View of f32[num_initial_views]: even in azimuth, elevations spread over the band.

    Azimuths lie half a spacing off the axes, equally many in each quadrant; elevations step through 1/6, 3/6 and 5/6 of
    the band (f32[2] rad).
    """
    number = jnp.arange(config.evaluation.num_initial_views, dtype=jnp.float32)
    azimuth = wrap_angle((number + 0.5) * (2.0 * jnp.pi / config.evaluation.num_initial_views))
    return View(azimuth, band[0] + (band[1] - band[0]) * (2.0 * (number % 3) + 1.0) / 6.0)


def search_trials(
    key: Array, env: ViewSearchEnv, search: Any, starts: tuple[Sight, Array], target: Sight
) -> SearchResult:
    """Runs a search from each of `starts` and returns the results, both with leading axis N.

    Args:
      key: PRNG key.
      env: the task.
      search: the searcher's function and its config.
      starts: Sight of f32[N, ...] of the initial views and their scores f32[N].
      target: Sight of the target.
    """
    function, config = search
    num_samples = config.num_samples if isinstance(config, RandomSearchConfig) else config.population

    def trial(item: tuple[Array, tuple[Sight, Array]]) -> SearchResult:
        trial_key, (start, score) = item
        args = SearchArgs(
            initial=start.view,
            band=env.reach.band,
            threshold=jnp.asarray(env.config.env.threshold),
            task=(start.qpos, target.code),
            initial_score=score,
        )
        return function(trial_key, functools.partial(score_view, env), args, config)

    keys = jax.random.split(key, starts[1].shape[0])
    return map_batched(trial, (keys, starts), max(1, env.config.evaluation.batch_size // num_samples))


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


def outcome(config: Config, result: SearchResult, camera: Camera, target: Camera) -> dict[str, Any]:
    """Returns the measures of a search that ended at `camera`, when `target` was looked for."""
    rotation, frobenius, translation = pose_error(camera, target)
    is_success = result.score >= config.env.threshold
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


def evaluate_policies(key: Array, env: ViewSearchEnv, state: TrainState, grid: Sight) -> dict[str, Any]:
    """Runs `num_episodes` episodes of every policy, initial views and targets random; see `evaluate` for the result."""
    settings = env.config.evaluation
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
    first = episode_of(start)
    args = SearchArgs(
        initial=first.sight.view,
        band=env.reach.band,
        threshold=jnp.asarray(env.config.env.threshold),
        task=sac.PolicyTask(actor, start),
        initial_score=start.metrics["similarity"],
    )
    result = sac.search(search_key, env.step, args, env.config)
    last = episode_of(result.end.state)
    return outcome(env.config, result, last.sight.camera, last.target.camera) | {
        "num_helped": result.end.num_helped,
        "initial_view": first.sight.view,
        "target_view": first.target.view,
        "steps_lower_bound": steps_lower_bound(first.sight.view, first.target, grid, env.reach.band, env.config),
    }


@functools.partial(jax.jit, static_argnames="config")
def record_search(state: TrainState, config: Config) -> dict[str, Array]:
    """Returns one search of the first policy in pictures: from the far side of the object to the protocol's target.

    Returns:
      `images` f32[T + 1, H, W, 3], start first, T = `episode_length`; `similarity` f32[T + 1]; `target` f32[H, W, 3];
      `num_steps` i32[], after which the rest repeats.
    """
    env = ViewSearchEnv(config, state.encoder, state.reach)
    actor = jax.tree.map(lambda x: x[0], state.sac.actor)
    initial_key, target_key = jax.random.split(jax.random.fold_in(state.key, 2**31 - 2))
    target_view = protocol_target(config)
    far_side = View(wrap_angle(target_view.azimuth + math.radians(165.0)), jnp.mean(env.reach.band))
    initial, _ = look_from_anywhere(env, (initial_key, far_side))
    target, _ = look_from_anywhere(env, (target_key, target_view))
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
