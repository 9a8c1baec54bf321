"""The lane pool returns for each problem the result that it has alone."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vsearch_jax.xla import lane_pool
from vsearch_jax.xla.batching import flatten_vmap

JOB = lane_pool.Job(
    reset=lambda problem, state, is_new: jnp.where(is_new, jnp.stack([problem, jnp.int32(0)]), state),
    step=lambda _, state: jnp.where(state[0] <= 0, state, state + jnp.array([-1, 1])),
    is_done=lambda state: state[0] <= 0,
    result=lambda problem, state: state[1] * 1000 + problem,
)


def _run_pool(num_lanes: int, _, problems):
    queue = lane_pool.queue_where(problems >= 0)
    return lane_pool.run(JOB, problems, queue, jnp.zeros((num_lanes, 2), jnp.int32), jnp.full_like(problems, -7))


@pytest.mark.parametrize("num_lanes", [1, 7, 16, 64])
def test_each_queued_problem_runs_once_and_to_its_end(num_lanes):
    problems = np.random.default_rng(0).integers(-3, 200, 150).astype(np.int32)
    found = jax.jit(functools.partial(_run_pool, num_lanes, None))(problems)
    np.testing.assert_array_equal(found, np.where(problems < 0, -7, problems * 1001))


def test_vmap_of_vmap_is_one_larger_batch():
    run_pool = flatten_vmap(functools.partial(_run_pool, 8))
    problems = jnp.arange(24).reshape(2, 3, 4)
    found = jax.jit(jax.vmap(jax.vmap(lambda p: run_pool(None, p))))(problems)
    np.testing.assert_array_equal(found, problems * 1001)
    with pytest.raises(NotImplementedError, match="not supported"):
        jax.vmap(flatten_vmap(lambda shared, p: p + shared))(jnp.ones(2), jnp.ones((2, 3)))
