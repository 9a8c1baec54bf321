"""CMA-ES against problems with a known optimum, and its strategy against pycma."""

import dataclasses
import functools
import math

import cma
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from evosax.algorithms.distribution_based.cma_es import CMA_ES

import probes
from vsearch_jax.config import CMAESConfig
from vsearch_jax.search import cma_es, cma_es_restarts
from vsearch_jax.types import SearchResult, View

CONFIG = CMAESConfig(sigma_deg=60.0)


@functools.partial(jax.jit, static_argnames=("score_fn", "config", "searcher"))
def run_searches(keys, args, score_fn, config, searcher=cma_es_restarts) -> SearchResult:
    return jax.vmap(lambda key, args: searcher.search(key, score_fn, args, config))(keys, args)


NUM = 240  # equal in all tests, so that they share compilations
KEYS = jax.random.split(jax.random.key(0), NUM)
INITIAL, TARGET = (probes.random_views(jax.random.key(seed), NUM) for seed in (1, 2))


@pytest.fixture(scope="module")
def result() -> SearchResult:
    return run_searches(KEYS, probes.search_problems(INITIAL, TARGET), probes.unreachable_outside_band, CONFIG)


def test_finds_the_target_past_a_false_optimum_within_60_images(result):
    found = np.asarray(result.score) >= probes.THRESHOLD
    assert found.mean() >= 0.98
    assert np.asarray(result.evaluations).mean() <= 60
    angles = jax.vmap(probes.angle_between)(result.view, TARGET)
    assert np.rad2deg(np.asarray(angles)[found].max()) < 6.0  # 0.98 is met within 5.3 degrees


def test_every_sample_lies_inside_the_band(result):
    assert int(result.unreachable.sum()) == 0


def test_a_search_across_the_azimuth_of_180_degrees_takes_as_many_images_as_elsewhere():
    elevation = jnp.full((NUM,), 1.0)
    means = []
    for azimuth in (0.0, math.pi):
        initial = View(jnp.full((NUM,), azimuth - 0.4), elevation)
        target = View(jnp.full((NUM,), -math.pi + 0.4 if azimuth else 0.4), elevation)
        problems = probes.search_problems(initial, target)
        means.append(
            np.asarray(run_searches(KEYS, problems, probes.unreachable_outside_band, CONFIG).evaluations).mean()
        )
    assert means[1] == pytest.approx(means[0], rel=0.25)


def test_a_search_that_starts_at_the_target_takes_one_image():
    result = run_searches(KEYS, probes.search_problems(TARGET, TARGET), probes.unreachable_outside_band, CONFIG)
    np.testing.assert_array_equal(result.evaluations, np.ones(NUM))


def test_restarts_leave_the_false_optimum_to_which_the_published_strategy_converges():
    problems = probes.search_problems(probes.opposite(TARGET), TARGET)
    narrow = CMAESConfig(sigma_deg=20.0, max_generations=60)
    rates = [
        (np.asarray(run_searches(KEYS, problems, probes.unreachable_outside_band, narrow, searcher).score) >= 0.98)
        for searcher in (cma_es, cma_es_restarts)
    ]
    assert rates[0].mean() <= 0.2
    assert rates[1].mean() >= 0.98


def test_the_search_uses_all_generations_and_stays_finite_if_nothing_is_reachable():
    config = CMAESConfig(max_generations=12)
    result = run_searches(KEYS, probes.search_problems(INITIAL, TARGET), probes.never_reachable, config)
    np.testing.assert_array_equal(result.evaluations, np.full(NUM, 121))
    np.testing.assert_array_equal(result.unreachable, np.full(NUM, 121))
    assert np.isfinite(np.asarray(result.view.azimuth)).all()


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_the_strategy_equals_pycma(seed):
    """Equal samples and parameters give equal distributions over 15 generations.

    Both sides use the parameters of pycma, because evosax has those of the tutorial of 2016: c_mu is 0.155 instead of
    0.181, c_sigma 0.508 instead of 0.5. The initial covariance of pycma differs from the identity by 1e-4. Both sides
    start with it.
    """
    sigma = 0.5
    oracle = cma.CMAEvolutionStrategy([0.0, 0.0], sigma, {"popsize": 10, "verbose": -9, "seed": seed})
    algorithm = CMA_ES(population_size=10, solution=jnp.zeros(2))
    step_size = oracle.adapt_sigma
    with cma_es.evosax_promotion():
        params = algorithm.default_params
    params = dataclasses.replace(
        params,
        std_init=jnp.float32(sigma),
        weights=jnp.asarray(np.array(oracle.sp.weights), jnp.float32),
        c_1=oracle.sp.c1,
        c_mu=oracle.sp.cmu,
        c_c=oracle.sp.cc,
        c_std=step_size.cs,
        d_std=step_size.damps,
        chi_n=math.sqrt(math.pi / 2.0),
    )
    state = cma_es.init_strategy(cma_es.Algorithm(algorithm, params, has_bounds=True), jnp.zeros(2))
    state = dataclasses.replace(state, C=jnp.asarray(oracle.sm.C, jnp.float32))
    key = jax.random.key(0)
    for _ in range(15):
        population = np.array(oracle.ask())
        fitness = [(x[0] - 1.0) ** 2 + 6.0 * (x[1] + 0.5) ** 2 for x in population]
        with cma_es.evosax_promotion():
            _, state = algorithm.ask(key, state, params)  # `ask` updates the eigenvectors
            state, _ = algorithm.tell(
                key, jnp.asarray(population, jnp.float32), jnp.asarray(fitness, jnp.float32), state, params
            )
        oracle.tell(population, fitness)
        np.testing.assert_allclose(state.mean, oracle.mean, atol=1e-4)
        np.testing.assert_allclose(state.std, oracle.sigma, rtol=1e-4)
        np.testing.assert_allclose(state.p_c, oracle.pc, atol=1e-4)
        np.testing.assert_allclose(state.p_std, step_size.ps, atol=1e-4)
        np.testing.assert_allclose(state.C, oracle.sm.C, atol=1e-4)


def test_with_a_penalty_samples_leave_the_band_and_are_counted_by_generation():
    """A search in parts, as the evaluation runs it. Bounds keep all samples reachable; the penalty does not."""
    problem = jax.tree.map(lambda x: x[0], probes.search_problems(INITIAL, TARGET))

    def run(config):
        method = cma_es.method(config)

        def run_generation(state, _):
            views, state = method.ask(KEYS[0], problem, state)
            scores = jax.vmap(probes.unreachable_outside_band, in_axes=(0, None))(views, problem.task)
            return method.tell(KEYS[0], problem, state, views, scores), jnp.sum(jnp.isneginf(scores))

        start = method.start(problem, jnp.float32(0.0))
        state, counts = jax.lax.scan(run_generation, start, length=config.max_generations)
        return counts, method.counts(state)["unreachable_by_generation"]

    counts, recorded = jax.jit(run, static_argnums=0)(CMAESConfig(constraint="penalty"))
    np.testing.assert_array_equal(recorded, counts)
    assert counts[0] > 0
    assert counts[-5:].sum() < counts[:5].sum()  # it learns where the arm reaches (thesis, figure 5.11)
    counts, recorded = jax.jit(run, static_argnums=0)(CONFIG)
    np.testing.assert_array_equal(recorded, np.zeros(CONFIG.max_generations))
