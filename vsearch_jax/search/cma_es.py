"""CMA-ES over azimuth and elevation (thesis 4.2) with evosax: the strategy as published, with bounds.

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

AZIMUTH_UNIT = math.pi / 2.0
"""One unit of the search space: 90 degrees of azimuth. In elevation it is half the height of the band."""
# Above the fitness of reachable views. 1 - cosine is at most 2; the rest leaves room for the bound penalty.
_UNREACHABLE_FITNESS = 5.0
# Fitness for each squared unit outside the band.
_BOUND_PENALTY = 1.0


class Algorithm(NamedTuple):
    """evosax's CMA-ES, its parameters, and the search space.

    Attributes:
      cma_es: the strategy.
      params: its parameters.
      has_bounds: whether samples stay inside the band. Then the second unit of the search space is half its height.
        Else it is 90 degrees of elevation.
    """

    cma_es: CMA_ES
    params: CMAESParams
    has_bounds: bool


@flax.struct.dataclass
class CMAESState:
    """State of the search; N is the population size. Points are in units of the search space.

    Attributes:
      record: what the search has found.
      strategy: evosax's state: mean, sigma, covariance and evolution paths.
      population: f32[N, 2], points of the last generation.
      unreachable: i32[G], number of samples of each generation that the arm cannot reach.
    """

    record: Record
    strategy: Strategy
    population: Array
    unreachable: Array


def search(key: Array, score_fn: ScoreFn[Task], args: SearchArgs[Task], config: CMAESConfig) -> SearchResult:
    """Searches the view sphere with CMA-ES for the view with the best score.

    The search starts at the initial view. A generation is the set of views (samples) whose images are taken before the
    strategy adapts. The fitness of a sample is 1 - cosine; lower is better. Azimuth is periodic and has no bounds. A
    sample outside the band (the elevations to search) is moved to the band's nearer end. The sample's squared distance
    to the band is added to the fitness (Hansen's boundary handling with a fixed weight).

    With `config.constraint` "penalty" (thesis 5.4) there is no band. Samples may be anywhere. The fitness of a sample
    that the arm cannot reach is 5, worse than that of any view.

    The search ends at the threshold or after `config.max_generations`. If the initial view meets the threshold, the
    search takes one image only.

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


def method(config: CMAESConfig) -> Method[CMAESState]:
    """Returns CMA-ES in parts (start, ask, tell, record), for a caller that takes the images itself."""
    algorithm = build_algorithm(config)
    return Method(
        start=functools.partial(init_state, algorithm, config),
        ask=lambda key, args, state: sample_views(
            algorithm, jax.random.fold_in(key, state.record.generation), args.band, state
        ),
        tell=functools.partial(update_state, algorithm),
        record=lambda state: state.record,
        num_views=config.population,
        counts=lambda state: {"unreachable_by_generation": state.unreachable},
    )


def build_algorithm(config: CMAESConfig) -> Algorithm:
    """Returns evosax's CMA-ES for two unknowns, with the population and the initial sigma of `config`."""
    sigma = math.radians(config.sigma_deg) / AZIMUTH_UNIT
    cma_es = CMA_ES(population_size=config.population, solution=jnp.zeros(2))
    with evosax_promotion():
        params = dataclasses.replace(cma_es.default_params, std_init=jnp.asarray(sigma, jnp.float32))
    return Algorithm(cma_es, params, config.constraint == "bounds")


def init_state(algorithm: Algorithm, config: CMAESConfig, args: SearchArgs[object], score: Array) -> CMAESState:
    """Returns the state at the start of a search: the mean of the strategy is the initial view.

    Args:
      algorithm: from `build_algorithm`.
      config: settings of CMA-ES.
      args: the search problem.
      score: f32[], score of the initial view.
    """
    return CMAESState(
        record=start_record(args.initial, score, config.max_generations),
        strategy=init_strategy(algorithm, to_point(algorithm, args.initial, args.band)),
        population=jnp.zeros((config.population, 2)),
        unreachable=jnp.zeros(config.max_generations, jnp.int32),
    )


def fitness_of(algorithm: Algorithm, population: Array, scores: Array, band: Array) -> Array:
    """Computes the fitness f32[N] of N points: 1 - score, plus the squared distance to the band.

    Args:
      algorithm: from `build_algorithm`.
      population: f32[N, 2], points in units of the search space.
      scores: f32[N], scores of the points' views; -inf where the arm cannot reach a view, whose fitness is 5.
      band: f32[2] rad, lowest and highest elevation of the search.
    """
    _, excess = to_views(algorithm, population, band)
    return jnp.where(jnp.isneginf(scores), _UNREACHABLE_FITNESS, 1.0 - scores) + _BOUND_PENALTY * excess**2


def sample_views(algorithm: Algorithm, key: Array, band: Array, state: CMAESState) -> tuple[View, CMAESState]:
    """Draws a generation of N samples.

    Args:
      algorithm: from `build_algorithm`.
      key: PRNG key of this generation.
      band: f32[2] rad, lowest and highest elevation of the search.
      state: the search before the generation.

    Returns:
      The views to observe, View of f32[N] rad; and the state that holds the generation.
    """
    with evosax_promotion():
        population, strategy = algorithm.cma_es.ask(key, state.strategy, algorithm.params)
    views, _ = to_views(algorithm, population, band)
    return views, dataclasses.replace(state, strategy=strategy, population=population)


def update_state(
    algorithm: Algorithm, key: Array, args: SearchArgs[object], state: CMAESState, views: View, scores: Array
) -> CMAESState:
    """Records a generation of N samples, and adapts mean, sigma and covariance to it.

    Args:
      algorithm: from `build_algorithm`.
      key: PRNG key, which evosax requires but does not use.
      args: the search problem.
      state: the state that `sample_views` returned.
      views: the observed views, View of f32[N] rad.
      scores: f32[N], scores of the views; -inf where the arm cannot reach a view.
    """
    fitness = fitness_of(algorithm, state.population, scores, args.band)
    with evosax_promotion():
        strategy, _ = algorithm.cma_es.tell(key, state.population, fitness, state.strategy, algorithm.params)
    record = add_generation(state.record, views, scores, args.threshold)
    count = jnp.sum(jnp.isneginf(scores), dtype=jnp.int32)
    unreachable = state.unreachable.at[state.record.generation].set(count)
    return dataclasses.replace(state, record=record, strategy=strategy, unreachable=unreachable)


@contextlib.contextmanager
def evosax_promotion() -> Iterator[None]:
    """Allows the promotion of types and ranks that evosax relies on, even if JAX is set to refuse it."""
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        yield


def init_strategy(algorithm: Algorithm, mean: Array) -> Strategy:
    """Returns a fresh strategy with the initial sigma and no memory.

    Args:
      algorithm: from `build_algorithm`.
      mean: f32[2], mean of the samples, in units of the search space.
    """
    with evosax_promotion():
        # evosax requires a key here, but draws nothing from it.
        strategy = algorithm.cma_es.init(jax.random.key(0), mean, algorithm.params)
    return dataclasses.replace(strategy, generation_counter=jnp.int32(-1))


def to_point(algorithm: Algorithm, view: View, band: Array) -> Array:
    """Returns the point of the search space of a view, f32[2].

    Args:
      algorithm: from `build_algorithm`.
      view: the view, f32[] rad.
      band: f32[2] rad, lowest and highest elevation of the search.
    """
    if not algorithm.has_bounds:
        return jnp.stack([view.azimuth, view.elevation]) / AZIMUTH_UNIT
    middle, half = jnp.mean(band), _half_height(band)
    return jnp.stack([view.azimuth / AZIMUTH_UNIT, (view.elevation - middle) / half])


def to_views(algorithm: Algorithm, points: Array, band: Array) -> tuple[View, Array]:
    """Converts points of the search space to views. With bounds each becomes the nearest view inside the band.

    Args:
      algorithm: from `build_algorithm`.
      points: f32[N, 2], in units of the search space.
      band: f32[2] rad, lowest and highest elevation of the search.

    Returns:
      Views of f32[N] rad; and the distances f32[N] in units from the points to the band, negative below the band.
    """
    azimuth = wrap_angle(points[:, 0] * AZIMUTH_UNIT)
    if not algorithm.has_bounds:
        return View(azimuth, points[:, 1] * AZIMUTH_UNIT), jnp.zeros(points.shape[0])
    inside = jnp.clip(points[:, 1], -1.0, 1.0)
    elevation = jnp.clip(jnp.mean(band) + inside * _half_height(band), band[0], band[1])
    return View(azimuth, elevation), points[:, 1] - inside


def _half_height(band: Array) -> Array:
    """Returns half the height of the band in rad. It is never 0, so that a division by it is finite."""
    return jnp.maximum(0.5 * (band[1] - band[0]), 1e-6)
