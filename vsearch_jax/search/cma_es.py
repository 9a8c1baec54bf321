"""CMA-ES over azimuth and elevation (thesis 4.2) with evosax, plus bounds and restarts.

evosax 0.3.2 follows Hansen's tutorial (arXiv 1604.00772) and uses its parameters of 2016. Its generation counter is one
too high in the stall indicator h_sigma (tutorial, page 28). Therefore the counter starts at -1 here. With that
correction and equal parameters, evosax agrees with `cma` 4.5 to 1e-5.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import math
from collections.abc import Iterator
from typing import NamedTuple

import flax.struct
import jax
import jax.numpy as jnp
from evosax.algorithms.distribution_based.cma_es import CMA_ES
from evosax.algorithms.distribution_based.cma_es import Params as CMAESParams
from evosax.algorithms.distribution_based.cma_es import State as Strategy
from jax import Array

from vsearch_jax.config import CMAESConfig
from vsearch_jax.geometry import wrap_angle
from vsearch_jax.search.common import (
    Method,
    Record,
    ScoreFn,
    SearchArgs,
    Task,
    add_generation,
    run_search,
    start_record,
)
from vsearch_jax.types import SearchResult, View
from vsearch_jax.xla.tree import tree_where

# One unit of the search space is 90 degrees of azimuth, or half the height of the band.
_AZIMUTH_UNIT = math.pi / 2.0
# Above the fitness of reachable views. 1 - cosine is at most 2; the rest leaves room for the bound penalty.
_UNREACHABLE_FITNESS = 5.0
# Fitness for each squared unit outside the band.
_BOUND_PENALTY = 1.0
# Smallest and largest sigma in rad of azimuth, for each unit of missing cosine. 1.5 is the k of random search.
_SIGMA_RANGE = (1.5, 9.0)
# The search restarts after this number of generations whose best fitness improves by less than _MIN_IMPROVEMENT.
_STALL_GENERATIONS = 6
_MIN_IMPROVEMENT = 3e-3


class _Algorithm(NamedTuple):
    """evosax's CMA-ES and its parameters."""

    cma_es: CMA_ES
    params: CMAESParams


@flax.struct.dataclass
class _State:
    """State of the search; N is the population size. Points are in units of the search space.

    Attributes:
      record: Record.
      strategy: evosax's state: mean, sigma, covariance and evolution paths.
      population: f32[N, 2], points of the last generation.
      run_fitness: f32[], best fitness since the last restart at a random point.
      run_point: f32[2], point with that fitness.
      stalled: i32[], number of generations since `run_fitness` improved.
    """

    record: Record
    strategy: Strategy
    population: Array
    run_fitness: Array
    run_point: Array
    stalled: Array


def search(key: Array, score_fn: ScoreFn[Task], args: SearchArgs[Task], config: CMAESConfig) -> SearchResult:
    """Searches the view sphere with CMA-ES for the view with the best score.

    The search starts at the initial view and restarts where it stalls. A generation is the set of views (samples) whose
    images are taken before the strategy adapts. The fitness of a sample is 1 - cosine; lower is better. Azimuth is
    periodic and has no bounds. A sample outside the band (the elevations to search) is moved to the band's nearer end.
    The sample's squared distance to the band is added to the fitness (Hansen's boundary handling with a fixed weight).

    Far from the target the cosine is nearly flat and has local optima. The plain strategy would converge to them. These
    rules prevent it:

    - Sigma stays between 1.5 and 9 rad for each unit of missing cosine, and never exceeds the initial sigma. If it is
      too small, it is raised. If it is too large, the strategy restarts at the best view of the present run.
    - After 6 generations without improvement, a new run starts at a random view.

    The record keeps the best view of all runs. The search ends at the threshold or after `config.max_generations`. If
    the initial view meets the threshold, the search takes one image only.

    Args:
      key: PRNG key.
      score_fn: maps (view, args.task) to the score f32[]: cosine similarity to the target, or -inf where the arm cannot
        reach the view. `jax.vmap` is applied to the function over a generation.
      args: initial view, band, threshold and task of one search problem.
      config: CMAESConfig. `sigma_deg` is the initial sigma in azimuth. In elevation, sigma scales with the band.

    Returns:
      The best view, its score and the number of images taken; best_scores is f32[config.max_generations].
    """
    return run_search(key, score_fn, args, method(config))


def method(config: CMAESConfig) -> Method[_State]:
    """Returns CMA-ES in parts (start, ask, tell, record), for a caller that takes the images itself."""
    sigma = math.radians(config.sigma_deg) / _AZIMUTH_UNIT
    cma_es = CMA_ES(population_size=config.population, solution=jnp.zeros(2))
    with _evosax_promotion():
        params = dataclasses.replace(cma_es.default_params, std_init=jnp.asarray(sigma, jnp.float32))
    algorithm = _Algorithm(cma_es, params)
    return Method(
        start=functools.partial(_init_state, algorithm, config),
        ask=functools.partial(_sample_views, algorithm),
        tell=functools.partial(_update_state, algorithm),
        record=lambda state: state.record,
        num_views=config.population,
    )


def _init_state(algorithm: _Algorithm, config: CMAESConfig, args: SearchArgs[object], score: Array) -> _State:
    return _State(
        record=start_record(args.initial, score, config.max_generations),
        strategy=_init_strategy(algorithm, _to_point(args.initial, args.band)),
        population=jnp.zeros((config.population, 2)),
        run_fitness=jnp.float32(jnp.inf),
        run_point=_to_point(args.initial, args.band),
        stalled=jnp.int32(0),
    )


def _generation_keys(key: Array, state: _State) -> tuple[Array, Array]:
    """Returns the present generation's keys of the samples and of a restart."""
    sample_key, restart_key = jax.random.split(jax.random.fold_in(key, state.record.generation))
    return sample_key, restart_key


def _sample_views(algorithm: _Algorithm, key: Array, args: SearchArgs[object], state: _State) -> tuple[View, _State]:
    with _evosax_promotion():
        sample_key, _ = _generation_keys(key, state)
        population, strategy = algorithm.cma_es.ask(sample_key, state.strategy, algorithm.params)
    views, _ = jax.vmap(_to_view, in_axes=(0, None))(population, args.band)
    return views, dataclasses.replace(state, strategy=strategy, population=population)


def _update_state(
    algorithm: _Algorithm, key: Array, args: SearchArgs[object], state: _State, views: View, scores: Array
) -> _State:
    """Returns the state after the strategy's update and the restart rules of `search`."""
    params, population = algorithm.params, state.population
    sample_key, restart_key = _generation_keys(key, state)
    _, excess = jax.vmap(_to_view, in_axes=(0, None))(population, args.band)
    fitness = jnp.where(jnp.isneginf(scores), _UNREACHABLE_FITNESS, 1.0 - scores) + _BOUND_PENALTY * excess**2
    with _evosax_promotion():
        strategy, _ = algorithm.cma_es.tell(sample_key, population, fitness, state.strategy, params)
    best = jnp.argmin(fitness)
    stalled = jnp.where(fitness[best] < state.run_fitness - _MIN_IMPROVEMENT, 0, state.stalled + 1)
    is_stalled = stalled >= _STALL_GENERATIONS
    run_point = jax.lax.select(fitness[best] < state.run_fitness, population[best], state.run_point)
    run_fitness = jnp.minimum(fitness[best], state.run_fitness)
    random_point = jax.random.uniform(restart_key, (2,), minval=jnp.array([-2.0, -1.0]), maxval=jnp.array([2.0, 1.0]))

    largest_axis = jnp.sqrt(jnp.linalg.eigvalsh(strategy.C)[-1])
    floor, ceiling = (jnp.minimum(k * run_fitness / _AZIMUTH_UNIT, params.std_init) for k in _SIGMA_RANGE)
    is_too_wide = strategy.std * largest_axis > ceiling
    strategy = dataclasses.replace(strategy, std=jnp.maximum(strategy.std, floor / largest_axis))
    restarted = _init_strategy(algorithm, jnp.where(is_stalled, random_point, run_point))
    restarted = dataclasses.replace(restarted, std=jnp.where(is_stalled, params.std_init, ceiling))
    return dataclasses.replace(
        state,
        record=add_generation(state.record, views, scores, args.threshold),
        strategy=tree_where(is_stalled | is_too_wide, restarted, strategy),
        run_fitness=jnp.where(is_stalled, jnp.inf, run_fitness),
        run_point=run_point,
        stalled=jnp.where(is_stalled, 0, stalled),
    )


@contextlib.contextmanager
def _evosax_promotion() -> Iterator[None]:
    """Allows the promotion of types and ranks that evosax relies on, even if JAX is set to refuse it."""
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        yield


def _init_strategy(algorithm: _Algorithm, mean: Array) -> Strategy:
    """Returns a fresh strategy with mean `mean` (f32[2] units) and the initial sigma."""
    with _evosax_promotion():
        # evosax requires a key here, but draws nothing from it.
        strategy = algorithm.cma_es.init(jax.random.key(0), mean, algorithm.params)
    return dataclasses.replace(strategy, generation_counter=jnp.int32(-1))


def _to_point(view: View, band: Array) -> Array:
    """Returns f32[2], the point of the search space for `view`."""
    middle, half = jnp.mean(band), _half_height(band)
    return jnp.stack([view.azimuth / _AZIMUTH_UNIT, (view.elevation - middle) / half])


def _to_view(point: Array, band: Array) -> tuple[View, Array]:
    """Returns the view inside the band that is nearest to `point` (f32[2] units), and the distance f32[] units to it.

    The distance has a sign: it is negative below the band.
    """
    inside = jnp.clip(point[1], -1.0, 1.0)
    elevation = jnp.clip(jnp.mean(band) + inside * _half_height(band), band[0], band[1])
    return View(azimuth=wrap_angle(point[0] * _AZIMUTH_UNIT), elevation=elevation), point[1] - inside


def _half_height(band: Array) -> Array:
    """Returns half the height of the band in rad. It is never 0, so that a division by it is finite."""
    return jnp.maximum(0.5 * (band[1] - band[0]), 1e-6)
