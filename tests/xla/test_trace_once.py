"""A function that is traced once: the number of traces, and equal results in, under and outside transformations."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vsearch_jax.xla.trace_once import trace_once


@pytest.fixture
def counted():
    """A function and the list of the sizes with which it was traced."""
    traces = []

    @trace_once("size")
    def scale(values, size, factor=2.0):
        traces.append(size)
        return factor * values * size

    return scale, traces


def test_one_program_that_calls_a_function_often_traces_it_once_for_each_static_value(counted):
    scale, traces = counted
    program = jax.jit(lambda x: scale(scale(x, size=3), 3) + scale(x, 5))
    np.testing.assert_allclose(program(jnp.arange(4.0)), 46.0 * np.arange(4.0))
    assert traces == [3, 5]
    np.testing.assert_allclose(jax.jit(lambda x: scale(x, 3) - x)(jnp.arange(4.0)), 5.0 * np.arange(4.0))
    assert traces == [3, 5], "another program uses the same trace"


def test_another_platform_gets_its_own_trace(counted, monkeypatch: pytest.MonkeyPatch):
    scale, traces = counted
    scale(jnp.ones(2), 3)
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    scale(jnp.ones(2), 3)
    assert traces == [3, 3]


def test_vmap_and_grad_pass_through(counted):
    scale, _ = counted
    batched = jax.vmap(lambda x: scale(x, 3))(jnp.arange(6.0).reshape(3, 2))
    np.testing.assert_allclose(batched, 6.0 * np.arange(6.0).reshape(3, 2))
    np.testing.assert_allclose(jax.grad(lambda x: scale(x, 3, 4.0).sum())(jnp.ones(2)), [12.0, 12.0])
