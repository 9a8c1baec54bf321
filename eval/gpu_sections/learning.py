"""Encoder updates, environment steps and SAC updates per second; whole runs of presets; the evaluation."""

from __future__ import annotations

import dataclasses
import functools
import time
from collections.abc import Iterator

import jax
import jax.numpy as jnp
import numpy as np

import vsearch_jax as vs
from gpu_sections.measure import Row, Settings, measure, sweep
from vsearch_jax.env import ViewSearchEnv
from vsearch_jax.search import sac
from vsearch_jax.training import encoder_iteration
from vsearch_jax.types import TrainState, Transition


def quick_config() -> vs.Config:
    """Returns the config of all sections of a quick run: `smoke` with silhouettes, which compile sooner."""
    smoke = vs.Config.preset("smoke")
    return dataclasses.replace(smoke, encoder=dataclasses.replace(smoke.encoder, input="silhouette"))


def rates(settings: Settings, trained: list[tuple[TrainState, vs.Config]]) -> Iterator[Row]:
    """Yields rows of encoder updates, environment steps and SAC updates per second against batch size.

    Args:
      settings: sizes and deadline.
      trained: from `train`; its first state has the encoder and the reachability map. Empty: both are computed.
    """
    state, config = trained[0] if trained else (None, quick_config() if settings.is_quick else vs.Config.preset("gpu"))
    env = ViewSearchEnv(config, state.encoder, state.reach) if state else ViewSearchEnv(config)
    batches = [8] if settings.is_quick else [64, 256, 1024, 4096]
    yield from sweep(batches, lambda batch: _encoder_updates(env, batch, settings))
    batches = [2] if settings.is_quick else [16, 160, 2048]
    yield from sweep(batches, lambda batch: _environment_steps(env, batch, settings))
    yield from sweep([1] if settings.is_quick else [1, 10, 100], lambda count: _sac_updates(env, count, settings))


def _encoder_updates(env: ViewSearchEnv, batch: int, settings: Settings) -> Row:
    """Times one update on `batch` random views, their rendering included."""
    config = dataclasses.replace(env.config, encoder=dataclasses.replace(env.config.encoder, batch_size=batch))
    sized = ViewSearchEnv(config, env.encoder, env.reach)
    update = functools.partial(encoder_iteration, env=sized, key=jax.random.key(0))
    row = measure("encoder update, views", batch, settings, lambda i, state: update(i, state)[0], 0, env.encoder)
    views = row.get("per_second")
    return row | {"updates_per_second": views / batch if isinstance(views, float) else None}


def _environment_steps(env: ViewSearchEnv, batch: int, settings: Settings) -> Row:
    states = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), batch))
    actions = jax.random.uniform(jax.random.key(1), (batch, env.action_size), minval=-1.0, maxval=1.0)
    return measure("environment steps", batch, settings, jax.vmap(env.step), states, actions)


def _sac_updates(env: ViewSearchEnv, num_policies: int, settings: Settings) -> Row:
    config, size, code_size = env.config.sac, env.observation_size, env.config.encoder.code_size
    keys = jax.random.split(jax.random.key(0), num_policies)
    states = jax.jit(jax.vmap(lambda key: sac.init(key, config, size, env.action_size, code_size)))(keys)
    shape = (num_policies, config.batch_size)
    obs, scalar = jnp.zeros((*shape, size)), jnp.zeros(shape)
    batch = Transition(obs, jnp.zeros((*shape, env.action_size)), scalar, obs, scalar, scalar + 1.0)
    update = jax.vmap(lambda key, state, batch: sac.update(key, state, batch, config)[0])
    row = measure("SAC updates of all policies", num_policies, settings, update, keys, states, batch)
    return row | {"transitions": config.batch_size}


def train(name: str, settings: Settings, trained: list[tuple[TrainState, vs.Config]]) -> Iterator[Row]:
    """Trains a preset until its end or the deadline, and yields its times.

    Args:
      name: of the preset.
      settings: holds the deadline; at least one chunk is trained.
      trained: receives the last state and the config.
    """
    config = quick_config() if settings.is_quick else vs.Config.preset(name)
    began = time.perf_counter()
    state = jax.block_until_ready(vs.init(jax.random.key(0), config))
    yield {"what": f"{name}: init, compiled and run", "seconds": time.perf_counter() - began}
    seconds: list[float] = []
    metrics: dict[str, jax.Array] = {}
    while int(state.step) < config.num_iterations and (settings.seconds_left > 0.0 or not seconds):
        began = time.perf_counter()
        state, metrics = jax.block_until_ready(vs.train(state, config))
        seconds.append(time.perf_counter() - began)
        if len(seconds) == 1:
            yield {"what": f"{name}: first chunk, compiled and run", "seconds": seconds[0]}
    trained.append((state, config))
    if len(seconds) > 1:
        mean = float(np.mean(seconds[1:]))
        yield {"what": f"{name}: mean of the later chunks", "seconds": mean, "iterations": config.chunk_length}
    done, ends = int(state.step), config.num_iterations
    whole: Row = {"what": f"{name}: whole run, without init", "seconds": sum(seconds), "iterations": done}
    yield whole | {"of": ends, "is_finished": done == ends}
    last = {key: np.asarray(metrics[key]) for key in ("encoder_loss", "reward", "success_rate")}
    means = {key: float(np.nanmean(x)) for key, x in last.items() if np.isfinite(x).any()}
    yield {"what": f"{name}: last chunk", **means}


def evaluate(settings: Settings, trained: list[tuple[TrainState, vs.Config]]) -> Iterator[Row]:
    """Yields the evaluation's time, with and without compilation, and each searcher's success.

    Another batch size follows, but not in a quick run: its compilation alone takes a third of the time.
    """
    if not trained:
        yield {"what": "not run: nothing was trained"}
        return
    state, config = trained[0]
    is_finished = int(state.step) == config.num_iterations
    for what in ("evaluation, compiled and run", "evaluation, again"):
        began = time.perf_counter()
        outcomes = jax.block_until_ready(vs.evaluate(state, config))
        yield {"what": what, "seconds": time.perf_counter() - began, "batch": config.evaluation.batch_size}
    for name, arrays in outcomes.items():
        success, images = np.mean(arrays["is_success"]), np.mean(arrays["evaluations"])
        row: Row = {"what": name, "success_rate": float(success), "evaluations_mean": float(images)}
        yield row | {"is_training_finished": is_finished}
    if settings.seconds_left > 0.0 and not settings.is_quick:
        settings_ = dataclasses.replace(config.evaluation, batch_size=config.evaluation.num_episodes // 8)
        other = dataclasses.replace(config, evaluation=settings_)
        jax.block_until_ready(vs.evaluate(state, other))
        began = time.perf_counter()
        jax.block_until_ready(vs.evaluate(state, other))
        yield {"what": "evaluation, again", "seconds": time.perf_counter() - began, "batch": settings_.batch_size}
