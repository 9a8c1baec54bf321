"""A fast stand-in for init, train, evaluate, record_search and the figures, without a scene and networks.

Tests of the loop of a run and of the command line use it. As a program it is the command `vsearch` with this stand-in:
`PYTHONPATH=tests python -m samples.fast_run train --preset smoke --out DIR`.
"""

import functools
import time
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
from matplotlib.figure import Figure

from samples import made_up
from vsearch_jax.cli.main import main
from vsearch_jax.config import Config
from vsearch_jax.report import page
from vsearch_jax.runs import loop
from vsearch_jax.training import POLICY_METRICS
from vsearch_jax.types import ReachabilityMap

CHUNK_SECONDS = 3.0
"""Duration of a chunk. A test needs this time to interrupt a chunk, also on a slow machine."""


@flax.struct.dataclass
class State:
    """A stand-in for TrainState."""

    weights: jax.Array
    reach: ReachabilityMap
    key: jax.Array
    step: jax.Array


@functools.partial(jax.jit, static_argnames="config")
def init(key: jax.Array, config: Config) -> State:
    """Returns random weights and a made-up reachability map."""
    return State(jax.random.normal(key, (1000,)), made_up.reach(), key, jnp.zeros((), jnp.int32))


@functools.partial(jax.jit, static_argnames="config", donate_argnames="state")
def _train(state: State, config: Config) -> tuple[State, dict[str, jax.Array]]:
    length = config.chunk_length
    iterations = state.step + jnp.arange(length)
    noise = jax.random.normal(jax.random.fold_in(state.key, state.step), state.weights.shape)
    is_encoder = iterations < config.encoder.num_updates
    metrics = {
        name: jnp.where(is_encoder, jnp.nan, 1.0 / (1 + iterations).astype(jnp.float32))
        for name in POLICY_METRICS
        if name != "value_loss"  # NaN without a value network
    }
    metrics["encoder_loss"] = jnp.where(is_encoder, state.weights[:length] ** 2, jnp.nan)
    metrics["false_match_rate"] = jnp.where(is_encoder, 0.25, jnp.nan)
    metrics["threshold_angle_deg"] = jnp.where(is_encoder, 3.5, jnp.nan)
    metrics["stage"] = jnp.where(is_encoder, 0, 1).astype(jnp.int32)
    step = jnp.minimum(state.step + length, config.num_iterations)
    return State(jnp.sin(state.weights + noise), state.reach, state.key, step), metrics


def train(state: State, config: Config) -> tuple[State, dict[str, jax.Array]]:
    """Does one chunk in `CHUNK_SECONDS`."""
    time.sleep(CHUNK_SECONDS)
    return _train(state, config)


def evaluate(state: State, config: Config) -> dict[str, Any]:
    """Returns made-up results."""
    return made_up.evaluation(config.sac.num_seeds)


def record_search(state: State, config: Config) -> dict[str, Any]:
    """Returns a made-up search."""
    return made_up.search()


def draw_figures(*results: Any) -> dict[str, Figure]:
    """Returns empty figures. The tests of the report draw the real ones, which takes seconds."""
    return {name: Figure(figsize=(0.5, 0.5)) for name in page.CAPTIONS}


def install() -> None:
    """Replaces the functions of the real run."""
    loop.init, loop.train, loop.evaluate, loop.record_search = init, train, evaluate, record_search
    page.draw_figures = draw_figures


if __name__ == "__main__":
    install()
    main()
