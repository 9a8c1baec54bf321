"""Encoder updates, environment steps, SAC updates; whole runs of the presets; the evaluation."""

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

# Share of the time left that a whole run may take.
RUN_SHARE = 0.6


def base_config(settings: Settings) -> vs.Config:
    """Returns the preset whose sizes the sections measure; a quick run reads silhouettes, which compile sooner."""
    if not settings.is_quick:
        return vs.Config.preset("gpu")
    smoke = vs.Config.preset("smoke")
    return dataclasses.replace(smoke, encoder=dataclasses.replace(smoke.encoder, input="silhouette"))


def rates(settings: Settings) -> Iterator[Row]:
    """Yields rows of encoder updates, environment steps and SAC updates per second against batch size."""
    config = base_config(settings)
    env = ViewSearchEnv(config)
    batches = [8] if settings.is_quick else [64, 256, 1024]
    yield from sweep(batches, lambda batch: _encoder(env, batch, settings), settings)
    if settings.is_quick:  # a step takes 15 s to compile; `run_preset` compiles it anyway
        yield {"what": "environment steps", "note": "measured in the whole run"}
    else:
        yield from sweep([16, 160, 1024], lambda batch: _steps(env, batch, settings), settings)
    for num_seeds in [1] if settings.is_quick else [1, 10]:
        yield _sac_updates(env, num_seeds, settings)


def _encoder(env: ViewSearchEnv, batch: int, settings: Settings) -> Row:
    """One update: `batch` views are rendered, augmented and clean, and fitted."""
    config = dataclasses.replace(env.config, encoder=dataclasses.replace(env.config.encoder, batch_size=batch))
    sized = ViewSearchEnv(config, env.encoder, env.reach)
    update = functools.partial(encoder_iteration, env=sized, key=jax.random.key(0))
    row = measure("encoder update, views", batch, settings, lambda i, state: update(i, state)[0], 0, env.encoder)
    views = row.get("per_second")
    return row | {"updates_per_second": views / batch if isinstance(views, float) else None}


def _steps(env: ViewSearchEnv, batch: int, settings: Settings) -> Row:
    states = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), batch))
    actions = jax.random.uniform(jax.random.key(1), (batch, env.action_size), minval=-1.0, maxval=1.0)
    return measure("environment steps", batch, settings, jax.vmap(env.step), states, actions)


def _sac_updates(env: ViewSearchEnv, num_seeds: int, settings: Settings) -> Row:
    config, size = env.config.sac, env.observation_size
    keys = jax.random.split(jax.random.key(0), num_seeds)
    states = jax.jit(jax.vmap(lambda key: sac.init(key, config, size, env.action_size)))(keys)
    shape = (num_seeds, config.batch_size)
    obs, scalar = jnp.zeros((*shape, size)), jnp.zeros(shape)
    batch = Transition(obs, jnp.zeros((*shape, env.action_size)), scalar, obs, scalar, scalar + 1.0)
    update = jax.vmap(lambda key, state, batch: sac.update(key, state, batch, config)[0])
    row = measure("SAC updates, all seeds", num_seeds, settings, update, keys, states, batch)
    return row | {"transitions": config.batch_size}


def run_preset(name: str, settings: Settings) -> tuple[list[Row], TrainState, vs.Config]:
    """Trains a preset until its end or until its share of the time is used up; returns rows, state and config."""
    config = base_config(settings) if settings.is_quick else vs.Config.preset(name)
    stop = time.perf_counter() + RUN_SHARE * settings.seconds_left
    began = time.perf_counter()
    state = jax.block_until_ready(vs.init(jax.random.key(0), config))
    rows: list[Row] = [{"what": f"{name}: init, compiled and run", "seconds": time.perf_counter() - began}]
    seconds: list[float] = []
    metrics: dict[str, jax.Array] = {}
    while int(state.step) < config.num_iterations and (time.perf_counter() < stop or not seconds):
        began = time.perf_counter()
        state, metrics = jax.block_until_ready(vs.train(state, config))
        seconds.append(time.perf_counter() - began)
    later = float(np.mean(seconds[1:])) if len(seconds) > 1 else None
    rows.append({"what": f"{name}: first chunk, compiled and run", "seconds": seconds[0]})
    rows.append({"what": f"{name}: mean of the later chunks", "seconds": later, "iterations": config.chunk_length})
    done = int(state.step)
    rows.append(
        {"what": f"{name}: whole run", "seconds": sum(seconds), "iterations": done, "of": config.num_iterations}
    )
    ends = {key: float(np.nanmean(metrics[key])) for key in ("encoder_loss", "reward", "success_rate")}
    rows.append({"what": f"{name}: last chunk", **{k: v for k, v in ends.items() if np.isfinite(v)}})
    return rows, state, config


def evaluate(state: TrainState, config: vs.Config) -> Iterator[Row]:
    """Yields the time of the evaluation, with and without compilation, and each searcher's success."""
    for what in ("evaluation, compiled and run", "evaluation, again"):
        began = time.perf_counter()
        outcomes = jax.block_until_ready(vs.evaluate(state, config))
        yield {"what": what, "seconds": time.perf_counter() - began}
    for name, arrays in outcomes.items():
        success, images = np.mean(arrays["is_success"]), np.mean(arrays["evaluations"])
        yield {"what": name, "success_rate": float(success), "evaluations_mean": float(images)}
