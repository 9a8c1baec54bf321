"""CMA-ES with scans and restarts: each run of the strategy of `cma_es` starts at the best view of a uniform scan."""

from __future__ import annotations

import dataclasses
import functools
import math

import flax.struct
import jax
import jax.numpy as jnp
from jax import Array

from vsearch_jax.config import CMAESConfig
from vsearch_jax.geometry import angle_difference, view_from_uniform
from vsearch_jax.search import cma_es
from vsearch_jax.search.cma_es import Algorithm, CMAESState
from vsearch_jax.search.common import Method, ScoreFn, SearchArgs, Task, run_search
from vsearch_jax.types import SearchResult, View
from vsearch_jax.xla.tree import tree_where

# These constants were tuned on the encodings of the teapot and of the plate of eval/parts.py, one seed each.
_SCAN_GENERATIONS = 2
"""Number of generations of a scan."""
_SIGMA = math.radians(30.0) / cma_es.AZIMUTH_UNIT
"""Initial sigma of a run, in units of the search space."""
_STALL_GENERATIONS, _MIN_IMPROVEMENT = 6, 0.1
"""A run ends after this number of generations that close less than this part of the gap to the threshold."""
_MIN_GAP = 0.01
"""Smallest gap, so that a run near the threshold does not count as stalled."""
_SMALLEST_STD = math.radians(3.0) / cma_es.AZIMUTH_UNIT
"""A run ends when the largest standard deviation of its samples is smaller, in units of the search space."""
_EXCLUDED_RADIUS = math.radians(20.0)
"""A run does not start at a view that is nearer to the end of an earlier run."""


@flax.struct.dataclass
class _State:
    """State of the search. A run is the part of a search between two scans.

    Attributes:
      base: state of the strategy.
      scans_left: i32[], number of generations until the present scan ends; 0 during a run.
      scan_fitness: f32[], best fitness of the present scan.
      scan_point: f32[2], the point of that fitness.
      run_fitness: f32[], best fitness of the present run.
      stalled: i32[], number of generations since `run_fitness` improved.
      ends: View of f32[R] rad, where the runs so far ended.
      num_restarts: i32[].
      scan_images: i32[], number of images taken by scans.
    """

    base: CMAESState
    scans_left: Array
    scan_fitness: Array
    scan_point: Array
    run_fitness: Array
    stalled: Array
    ends: View
    num_restarts: Array
    scan_images: Array


def search(key: Array, score_fn: ScoreFn[Task], args: SearchArgs[Task], config: CMAESConfig) -> SearchResult:
    """Searches the view sphere with runs of CMA-ES, each of which starts at the best view of a uniform scan.

    Far from the target the cosine is nearly flat and has local optima, to which CMA-ES converges. A scan takes images
    of 2 generations that are uniform over the band. A run of CMA-ES starts at the best of them, with a sigma of 30
    degrees. The run ends after 6 generations without improvement, or when the largest standard deviation of its samples
    is below 3 degrees. Then a new scan begins. Views within 20 degrees of the end of an earlier run are not chosen. The
    record keeps the best view of all. All else is as in `cma_es.search`.

    Args:
      key: PRNG key.
      score_fn: maps (view, args.task) to the score f32[]: cosine similarity to the target, or -inf where the arm cannot
        reach the view. `jax.vmap` is applied to the function over a generation.
      args: initial view, band, threshold and task of one search problem.
      config: CMAESConfig. `sigma_deg` is not used.

    Returns:
      The best view, its score and the number of images taken; best_scores is f32[config.max_generations].
    """
    return run_search(key, score_fn, args, method(config))


def method(config: CMAESConfig) -> Method[_State]:
    """Returns this searcher in parts (start, ask, tell, record), for a caller that takes the images itself."""
    algorithm = cma_es.build_algorithm(config)
    return Method(
        start=functools.partial(_init_state, algorithm, config),
        ask=functools.partial(_sample_views, algorithm),
        tell=functools.partial(_update_state, algorithm),
        record=lambda state: state.base.record,
        num_views=config.population,
        counts=lambda state: {
            "num_restarts": state.num_restarts,
            "scan_images": state.scan_images,
            "unreachable_by_generation": state.base.unreachable,
        },
    )


def _init_state(algorithm: Algorithm, config: CMAESConfig, args: SearchArgs[object], score: Array) -> _State:
    max_runs = config.max_generations // (_SCAN_GENERATIONS + 1) + 1
    infinite = jnp.float32(jnp.inf)
    return _State(
        base=cma_es.init_state(algorithm, config, args, score),
        scans_left=jnp.int32(_SCAN_GENERATIONS),
        scan_fitness=infinite,
        scan_point=jnp.zeros(2),
        run_fitness=infinite,
        stalled=jnp.int32(0),
        ends=View(jnp.zeros(max_runs), jnp.zeros(max_runs)),
        num_restarts=jnp.int32(0),
        scan_images=jnp.int32(0),
    )


def _sample_views(algorithm: Algorithm, key: Array, args: SearchArgs[object], state: _State) -> tuple[View, _State]:
    sample_key, scan_key = jax.random.split(jax.random.fold_in(key, state.base.record.generation))
    views, base = cma_es.sample_views(algorithm, sample_key, args.band, state.base)
    uniform = view_from_uniform(jax.random.uniform(scan_key, (2, base.population.shape[0])), args.band)
    is_scan = state.scans_left > 0
    points = jax.vmap(functools.partial(cma_es.to_point, algorithm, band=args.band))(uniform)
    base = dataclasses.replace(base, population=jnp.where(is_scan, points, base.population))
    return tree_where(is_scan, uniform, views), dataclasses.replace(state, base=base)


def _update_state(
    algorithm: Algorithm, key: Array, args: SearchArgs[object], state: _State, views: View, scores: Array
) -> _State:
    """Returns the state after one generation, of a scan or of a run."""
    base = cma_es.update_state(algorithm, key, args, state.base, views, scores)
    fitness = cma_es.fitness_of(algorithm, base.population, scores, args.band)
    is_scan = state.scans_left > 0
    scanned = _after_scan(algorithm, state, base, views, fitness)
    searched = _after_generation(algorithm, args, state, base, fitness)
    return tree_where(is_scan, scanned, searched)


def _after_scan(algorithm: Algorithm, state: _State, base: CMAESState, views: View, fitness: Array) -> _State:
    """Keeps the best sample of a scan. After the scan's last generation a run starts there."""
    azimuth = angle_difference(views.azimuth[:, None], state.ends.azimuth[None])
    distance = jnp.hypot(azimuth, views.elevation[:, None] - state.ends.elevation[None])
    is_end = jnp.arange(state.ends.azimuth.shape[0]) < state.num_restarts
    is_excluded = jnp.any(is_end[None] & (distance < _EXCLUDED_RADIUS), axis=1)
    fitness = jnp.where(is_excluded, jnp.inf, fitness)
    best = jnp.argmin(fitness)
    is_better = fitness[best] < state.scan_fitness
    point = jnp.where(is_better, base.population[best], state.scan_point)
    scans_left = state.scans_left - 1
    started = dataclasses.replace(cma_es.init_strategy(algorithm, point), std=jnp.float32(_SIGMA))
    # The strategy does not learn from a scan.
    strategy = tree_where(scans_left == 0, started, state.base.strategy)
    return dataclasses.replace(
        state,
        base=dataclasses.replace(base, strategy=strategy),
        scans_left=scans_left,
        scan_fitness=jnp.minimum(state.scan_fitness, fitness[best]),
        scan_point=point,
        scan_images=state.scan_images + base.record.evaluations - state.base.record.evaluations,
    )


def _after_generation(
    algorithm: Algorithm, args: SearchArgs[object], state: _State, base: CMAESState, fitness: Array
) -> _State:
    """Ends a run that stalls or has converged; then a scan begins."""
    best, strategy = jnp.min(fitness), base.strategy
    gap = jnp.maximum(state.run_fitness - (1.0 - args.threshold), _MIN_GAP)
    has_improved = jnp.isinf(state.run_fitness) | (best < state.run_fitness - _MIN_IMPROVEMENT * gap)
    stalled = jnp.where(has_improved, 0, state.stalled + 1)
    largest_std = strategy.std * jnp.sqrt(jnp.linalg.eigvalsh(strategy.C)[-1])
    is_over = (stalled >= _STALL_GENERATIONS) | (largest_std < _SMALLEST_STD)
    end, _ = cma_es.to_views(algorithm, strategy.mean[None], args.band)
    ends = jax.tree.map(lambda all_ends, one: all_ends.at[state.num_restarts].set(one[0]), state.ends, end)
    return dataclasses.replace(
        state,
        base=base,
        scans_left=jnp.where(is_over, _SCAN_GENERATIONS, 0),
        scan_fitness=jnp.float32(jnp.inf),
        run_fitness=jnp.where(is_over, jnp.inf, jnp.minimum(best, state.run_fitness)),
        stalled=jnp.where(is_over, 0, stalled),
        ends=tree_where(is_over, ends, state.ends),
        num_restarts=state.num_restarts + is_over.astype(jnp.int32),
    )
