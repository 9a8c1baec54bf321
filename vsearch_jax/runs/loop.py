"""A run from start to report: the host's loop of equal chunks, saving and reporting between them.

After each chunk its metrics go to the disk first, then the checkpoint; whatever kills the run in between, the run goes
on from the last checkpoint, and metrics past it are dropped. So the run needs no care at an interrupt.
"""

from __future__ import annotations

import contextlib
import ctypes
import gc
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from vsearch_jax.config import Config, ConfigError
from vsearch_jax.evaluation import check_target, evaluate, record_search
from vsearch_jax.runs import checkpoint
from vsearch_jax.runs.folder import MAX_SEED, RunError, new_run_folder, read_config, read_seed, write_config
from vsearch_jax.runs.interrupts import OnInterrupt, call_interruptibly, stop_on_signal
from vsearch_jax.runs.metrics_log import STAGES, MetricsLog, read_metrics
from vsearch_jax.training import init, train
from vsearch_jax.types import ReachabilityMap, TrainState


def start_run(run: Path, config: Config, seed: int) -> TrainState:
    """Makes the folder `run` and returns the state at the start, saved there as the checkpoint of step 0.

    If that fails the folder is left empty.

    Raises:
      RunError: the folder exists and holds something.
      ConfigError, SceneError: the config or the seed can't be run.
      OSError: the disk is full or not writable.
    """
    if not 0 <= seed <= MAX_SEED:
        raise ConfigError(f"seed is {seed}; allowed: 0 to {MAX_SEED}")
    with new_run_folder(run):
        state = call_interruptibly(init, jax.random.key(seed), config)
        check_target(state.reach, config)  # now, not when the training is done
        write_config(run, config, seed)
        checkpoint.save(run, state, config)
    return state


def resume_run(run: Path, config: Config) -> TrainState:
    """Returns the state of the last checkpoint in the folder `run`.

    Raises:
      RunError: there is no run in the folder.
      CheckpointError: the checkpoint is missing, damaged or of another config.
      ConfigError: the arm can't reach the target view.
    """
    saved, seed = read_config(run), read_seed(run)
    template = jax.eval_shape(lambda key: init(key, config), jax.random.key(0))
    state = checkpoint.restore(run, template, config)
    check_target(state.reach, config)
    if saved != config:  # in what only evaluation reads
        write_config(run, config, seed)
    return state


OnChunk = Callable[[int, float, Sequence[Mapping[str, Any]]], None]
"""Takes iterations done, the chunk's wall time in s and its lines of metrics.jsonl."""


def train_to_end(
    run: Path, state: TrainState, config: Config, on_chunk: OnChunk, on_interrupt: OnInterrupt = lambda: None
) -> TrainState:
    """Trains from `state` to the end of the run, saving after each chunk.

    An interrupt lets the running chunk end and saves it; a second one leaves it at once.

    Args:
      run: the run's folder.
      state: from `start_run` or `resume_run`; donated.
      config: the run's config.
      on_chunk: called after each chunk is saved.
      on_interrupt: called at the first interrupt.

    Raises:
      KeyboardInterrupt: the run was interrupted; the last checkpoint holds what was saved.
      RunError: the training diverged, or metrics.jsonl is damaged.
      OSError: the disk is full or not writable; the last checkpoint stays.
    """
    with stop_on_signal(on_interrupt) as is_stopping:
        return _train_chunks(run, state, config, on_chunk, is_stopping)


def _train_chunks(
    run: Path, state: TrainState, config: Config, on_chunk: OnChunk, is_stopping: threading.Event
) -> TrainState:
    step = int(state.step)
    log = MetricsLog(run, step)
    while step < config.num_iterations:
        began = time.perf_counter()
        state, metrics = call_interruptibly(train, state, config)
        seconds = time.perf_counter() - began
        new_step = int(state.step)
        # The last chunk may be shorter than its arrays.
        columns = {name: np.asarray(column)[: new_step - step] for name, column in metrics.items()}
        check_finite(run, columns, step, config)
        log.append(columns, step, seconds)
        checkpoint.save(run, state, config)
        on_chunk(new_step, seconds, log.lines[step - new_step :])
        step = new_step
        if is_stopping.is_set():
            raise KeyboardInterrupt
    log.close()
    return state


def check_finite(run: Path, columns: Mapping[str, np.ndarray], step: int, config: Config) -> None:
    """Raises RunError where the training diverged in a chunk that began at iteration `step`; nothing of it is saved."""
    number = step + np.arange(len(columns["stage"])) - config.encoder.num_updates
    is_encoder, is_policy = number < 0, number >= 0
    is_updated = number * config.sac.num_envs >= config.sac.num_warmup_steps
    checks = {"encoder_loss": is_encoder, "reward": is_policy, "critic_loss": is_updated, "actor_loss": is_updated}
    for name, is_there in checks.items():
        if not np.isfinite(columns[name][is_there]).all():
            raise RunError(
                f"{run}: {name} is not finite after iteration {step}: the training diverged, and that is not saved; "
                f"start anew with a smaller {'encoder' if name == 'encoder_loss' else 'sac'}.learning-rate"
            )


class Evaluated(NamedTuple):
    """What a report is made of.

    Attributes:
      arrays: what `evaluate` returns.
      search: what `record_search` returns, as numpy arrays.
      reach: the arm's reachability map.
      lines: the lines of metrics.jsonl.
      wall_seconds: wall time in s of each stage of the run.
      seed: of the run.
    """

    arrays: dict[str, Any]
    search: dict[str, np.ndarray]
    reach: ReachabilityMap
    lines: list[dict[str, Any]]
    wall_seconds: dict[str, float]
    seed: int


def evaluate_run(run: Path, state: TrainState, config: Config) -> Evaluated:
    """Evaluates a trained state.

    Args:
      run: the run's folder.
      state: of the run.
      config: the run's, but for what `evaluate` lets differ.

    Raises:
      RunError: the run is not finished.
      ConfigError: the arm can't reach the target view.
    """
    check_finished(run, state, config)
    lines, seed = read_metrics(run), read_seed(run)
    release_memory()  # of the compiled training, some GiB
    began = time.perf_counter()
    arrays = call_interruptibly(evaluate, state, config)
    wall_seconds: dict[str, float] = {
        stage: sum(line["seconds"] for line in lines if line["stage"] == stage) for stage in STAGES
    }
    wall_seconds["evaluation"] = time.perf_counter() - began
    search = jax.tree.map(np.asarray, call_interruptibly(record_search, state, config))
    return Evaluated(arrays, search, state.reach, lines, wall_seconds, seed)


def check_finished(run: Path, state: TrainState, config: Config) -> None:
    """Raises RunError where the run in the folder `run`, its state given, has iterations left."""
    step, end = int(state.step), config.num_iterations
    if step < end:
        raise RunError(f"{run} has done {step} of {end} iterations; finish it: vsearch train --out {run} --resume")


def release_memory() -> None:
    """Drops compiled programs and hands their memory back to the system, which glibc does not do by itself."""
    jax.clear_caches()
    gc.collect()
    with contextlib.suppress(AttributeError, OSError):  # another C library
        ctypes.CDLL(None).malloc_trim(0)
