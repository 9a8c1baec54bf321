"""CMA-ES over azimuth and elevation (thesis 4.2), evosax's, with bounds and restarts.

evosax 0.3.2 follows Hansen's tutorial (arXiv 1604.00772) with its parameters of 2016. Its generation counter is one
ahead in the stall indicator h_sigma (tutorial, page 28), so states start at -1 here; with that it equals `cma` 4.5 to
1e-5 when both use the same parameters.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import math
from collections.abc import Iterator
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
from evosax.algorithms.distribution_based.cma_es import CMA_ES
from jax import Array

from vsearch_jax.config import CMAESConfig
from vsearch_jax.geometry import wrap_angle
from vsearch_jax.search.common import Method, Record, ScoreFn, SearchArgs, add_generation, run_search, start_record
from vsearch_jax.types import SearchResult, View
from vsearch_jax.xla.tree import tree_where

# One unit of the search space is a quarter turn of azimuth and half the band's height of elevation.
_AZIMUTH_UNIT = math.pi / 2.0
_UNREACHABLE_FITNESS = 5.0  # above 1 - cosine, at most 2, by more than the bounds' penalty
_BOUND_PENALTY = 1.0  # for each squared unit outside the band
_SIGMA_RANGE = (1.5, 9.0)  # rad of azimuth for each unit of missing cosine; the first is random search's k
_STALL_GENERATIONS = 6
_STALL_IMPROVEMENT = 3e-3


@flax.struct.dataclass
class _State:
    """State of the search.

    Attributes:
      record: Record.
      strategy: evosax's state.
      population: f32[N, 2] units, the generation that was asked for.
      run_fitness: f32[], best fitness since the last restart at a random view.
      run_point: f32[2] units, where it was seen.
      stalled: i32[], generations since it improved.
    """

    record: Record
    strategy: Any
    population: Array
    run_fitness: Array
    run_point: Array
    stalled: Array


def search(key: Array, score_fn: ScoreFn, args: SearchArgs, config: CMAESConfig) -> SearchResult:
    """Searches the view sphere by CMA-ES that starts at the initial view and restarts where it gets stuck.

    Azimuth is periodic, so it has no bounds. A sample whose elevation is outside the band is moved to its edge, and its
    squared distance is added to the fitness 1 - cosine (Hansen's boundary handling, with a fixed weight).

    Far from the target the cosine is nearly flat and has local optima, on which the plain strategy contracts. Rules
    keep it from that: the step size stays between 1.5 and 9 rad for each unit of missing cosine, and not above the
    initial one; below, it is raised; above, the strategy starts anew at the best view of this start. After six
    generations without improvement it starts anew at a random view. The best view of all starts is kept. The search
    ends at the threshold or after `config.max_generations`; if the initial view meets the threshold, after its one
    image.

    Args:
      key: PRNG key.
      score_fn: maps (view, args.task) to the score, f32[]; -inf where unreachable. It is vmapped over the samples.
      args: SearchArgs of one problem.
      config: CMAESConfig; `sigma_deg` is the step size in azimuth; in elevation it is in proportion to the band.

    Returns:
      SearchResult with best_scores f32[config.max_generations].
    """
    return run_search(key, score_fn, args, method(config))


def method(config: CMAESConfig) -> Method:
    """Returns the searcher's parts."""
    sigma = math.radians(config.sigma_deg) / _AZIMUTH_UNIT
    algorithm = CMA_ES(population_size=config.population, solution=jnp.zeros(2))
    with _evosax_promotion():
        params = algorithm.default_params.replace(std_init=jnp.asarray(sigma, jnp.float32))
    return Method(
        start=functools.partial(_begin, (algorithm, params), config),
        ask=functools.partial(_ask, (algorithm, params)),
        tell=functools.partial(_tell, (algorithm, params)),
        record=lambda state: state.record,
        num_views=config.population,
    )


def _begin(cma: tuple[CMA_ES, Any], config: CMAESConfig, args: SearchArgs, score: Array) -> _State:
    return _State(
        record=start_record(args.initial, score, config.max_generations),
        strategy=_start(*cma, _to_units(args.initial, args.band)),
        population=jnp.zeros((config.population, 2)),
        run_fitness=jnp.float32(jnp.inf),
        run_point=_to_units(args.initial, args.band),
        stalled=jnp.int32(0),
    )


def _keys(key: Array, state: _State) -> tuple[Array, Array]:
    """Returns the generation's keys of the samples and of a restart."""
    sample_key, restart_key = jax.random.split(jax.random.fold_in(key, state.record.generation))
    return sample_key, restart_key


def _ask(cma: tuple[CMA_ES, Any], key: Array, args: SearchArgs, state: _State) -> tuple[View, _State]:
    algorithm, params = cma
    with _evosax_promotion():
        population, strategy = algorithm.ask(_keys(key, state)[0], state.strategy, params)
    views, _ = jax.vmap(_to_view, in_axes=(0, None))(population, args.band)
    return views, dataclasses.replace(state, strategy=strategy, population=population)


def _tell(cma: tuple[CMA_ES, Any], key: Array, args: SearchArgs, state: _State, views: View, scores: Array) -> _State:
    (algorithm, params), population, strategy = cma, state.population, state.strategy
    sample_key, restart_key = _keys(key, state)
    _, excess = jax.vmap(_to_view, in_axes=(0, None))(population, args.band)
    fitness = jnp.where(jnp.isneginf(scores), _UNREACHABLE_FITNESS, 1.0 - scores) + _BOUND_PENALTY * excess**2
    with _evosax_promotion():
        strategy, _ = algorithm.tell(sample_key, population, fitness, strategy, params)
    best = jnp.argmin(fitness)
    stalled = jnp.where(fitness[best] < state.run_fitness - _STALL_IMPROVEMENT, 0, state.stalled + 1)
    is_stalled = stalled >= _STALL_GENERATIONS
    run_point = jax.lax.select(fitness[best] < state.run_fitness, population[best], state.run_point)
    run_fitness = jnp.minimum(fitness[best], state.run_fitness)
    random_point = jax.random.uniform(restart_key, (2,), minval=jnp.array([-2.0, -1.0]), maxval=jnp.array([2.0, 1.0]))

    largest_axis = jnp.sqrt(jnp.linalg.eigvalsh(strategy.C)[-1])
    floor, ceiling = (jnp.minimum(k * run_fitness / _AZIMUTH_UNIT, params.std_init) for k in _SIGMA_RANGE)
    is_wide = strategy.std * largest_axis > ceiling
    strategy = strategy.replace(std=jnp.maximum(strategy.std, floor / largest_axis))
    fresh = _start(algorithm, params, jnp.where(is_stalled, random_point, run_point))
    fresh = fresh.replace(std=jnp.where(is_stalled, params.std_init, ceiling))
    return dataclasses.replace(
        state,
        record=add_generation(state.record, views, scores, args.threshold),
        strategy=tree_where(is_stalled | is_wide, fresh, strategy),
        run_fitness=jnp.where(is_stalled, jnp.inf, run_fitness),
        run_point=run_point,
        stalled=jnp.where(is_stalled, 0, stalled),
    )


@contextlib.contextmanager
def _evosax_promotion() -> Iterator[None]:
    """Lets evosax promote types and ranks, on which it relies, also where jax is told to be strict."""
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        yield


def _start(algorithm: CMA_ES, params: Any, mean: Array) -> Any:
    with _evosax_promotion():
        strategy = algorithm.init(jax.random.key(0), mean, params)  # it draws nothing from the key
    return strategy.replace(generation_counter=jnp.int32(-1))


def _to_units(view: View, band: Array) -> Array:
    """Returns f32[2], the point of the search space for `view`."""
    middle, half = jnp.mean(band), _half_height(band)
    return jnp.stack([view.azimuth / _AZIMUTH_UNIT, (view.elevation - middle) / half])


def _to_view(point: Array, band: Array) -> tuple[View, Array]:
    """Returns the view at or nearest to `point` (f32[2]) inside the band, and how many units outside the point is."""
    inside = jnp.clip(point[1], -1.0, 1.0)
    elevation = jnp.clip(jnp.mean(band) + inside * _half_height(band), band[0], band[1])
    return View(azimuth=wrap_angle(point[0] * _AZIMUTH_UNIT), elevation=elevation), point[1] - inside


def _half_height(band: Array) -> Array:
    return jnp.maximum(0.5 * (band[1] - band[0]), 1e-6)  # a band of one elevation keeps the division finite
