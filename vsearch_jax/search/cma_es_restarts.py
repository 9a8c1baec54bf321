"""CMA-ES with restarts: the strategy of `cma_es`, begun anew at a random view where it has converged or stalls."""

from __future__ import annotations

import dataclasses
import functools
import math

import flax.struct
import jax
import jax.numpy as jnp
from jax import Array

from vsearch_jax.config import CMAESConfig
from vsearch_jax.search import cma_es
from vsearch_jax.search.cma_es import Algorithm, CMAESState
from vsearch_jax.search.common import Method, ScoreFn, SearchArgs, Task, run_search
from vsearch_jax.types import SearchResult, View
from vsearch_jax.xla.tree import tree_where

# A run ends after this number of generations whose best fitness improves by less than _MIN_IMPROVEMENT.
_STALL_GENERATIONS = 5
_MIN_IMPROVEMENT = 3e-3
# A run ends when the largest standard deviation is smaller than this, in units of the search space.
_SMALLEST_STD = math.radians(1.0) / cma_es.AZIMUTH_UNIT


@flax.struct.dataclass
class _State:
    """State of the search. A run is the part of a search between two restarts.

    Attributes:
      base: state of the strategy.
      run_fitness: f32[], best fitness of the present run.
      stalled: i32[], number of generations since `run_fitness` improved.
      num_restarts: i32[].
    """

    base: CMAESState
    run_fitness: Array
    stalled: Array
    num_restarts: Array


def search(key: Array, score_fn: ScoreFn[Task], args: SearchArgs[Task], config: CMAESConfig) -> SearchResult:
    """Searches the view sphere with CMA-ES, and begins anew at a random view where a run has converged or stalls.

    Far from the target the cosine is nearly flat and has local optima, to which CMA-ES converges. A new run begins
    after 5 generations without improvement, or when the largest standard deviation of the samples is below 1 degree of
    azimuth. The record keeps the best view of all runs. All else is as in `cma_es.search`.

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
    """Returns CMA-ES with restarts in parts (start, ask, tell, record), for a caller that takes the images itself."""
    algorithm = cma_es.build_algorithm(config)
    return Method(
        start=functools.partial(_init_state, algorithm, config),
        ask=functools.partial(_sample_views, algorithm),
        tell=functools.partial(_update_state, algorithm),
        record=lambda state: state.base.record,
        num_views=config.population,
        counts=lambda state: {
            "num_restarts": state.num_restarts,
            "unreachable_by_generation": state.base.unreachable,
        },
    )


def _init_state(algorithm: Algorithm, config: CMAESConfig, args: SearchArgs[object], score: Array) -> _State:
    zero = jnp.int32(0)
    return _State(cma_es.init_state(algorithm, config, args, score), jnp.float32(jnp.inf), zero, zero)


def _generation_keys(key: Array, state: _State) -> tuple[Array, Array]:
    """Returns the present generation's keys of the samples and of a restart."""
    sample_key, restart_key = jax.random.split(jax.random.fold_in(key, state.base.record.generation))
    return sample_key, restart_key


def _sample_views(algorithm: Algorithm, key: Array, args: SearchArgs[object], state: _State) -> tuple[View, _State]:
    sample_key, _ = _generation_keys(key, state)
    views, base = cma_es.sample_views(algorithm, sample_key, args.band, state.base)
    return views, dataclasses.replace(state, base=base)


def _update_state(
    algorithm: Algorithm, key: Array, args: SearchArgs[object], state: _State, views: View, scores: Array
) -> _State:
    """Returns the state after the strategy's update and the restart rules of `search`."""
    sample_key, restart_key = _generation_keys(key, state)
    base = cma_es.update_state(algorithm, sample_key, args, state.base, views, scores)
    strategy, best = base.strategy, cma_es.fitness_of(algorithm, base.population, scores, args.band).min()
    stalled = jnp.where(best < state.run_fitness - _MIN_IMPROVEMENT, 0, state.stalled + 1)
    largest_std = strategy.std * jnp.sqrt(jnp.linalg.eigvalsh(strategy.C)[-1])
    is_over = (stalled >= _STALL_GENERATIONS) | (largest_std < _SMALLEST_STD)
    point = jax.random.uniform(restart_key, (2,), minval=jnp.array([-2.0, -1.0]), maxval=jnp.array([2.0, 1.0]))
    strategy = tree_where(is_over, cma_es.init_strategy(algorithm, point), strategy)
    return _State(
        base=dataclasses.replace(base, strategy=strategy),
        run_fitness=jnp.where(is_over, jnp.inf, jnp.minimum(best, state.run_fitness)),
        stalled=jnp.where(is_over, 0, stalled),
        num_restarts=state.num_restarts + is_over.astype(jnp.int32),
    )
