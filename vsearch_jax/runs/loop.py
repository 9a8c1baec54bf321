"""A run from start to evaluation: the host calls `train` once for each chunk and saves after each chunk.

After a chunk, its metrics are written first, then its checkpoint. A crash between the two loses nothing: the run
resumes from the last checkpoint, and metrics of later iterations are removed.
"""

from __future__ import annotations

import contextlib
import ctypes
import gc
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np

from vsearch_jax.config import Config, ConfigError
from vsearch_jax.evaluation import Outcome, check_target, evaluate, record_search
from vsearch_jax.runs import checkpoint
from vsearch_jax.runs.folder import (
    MAX_SEED,
    RunError,
    new_run_folder,
    read_config,
    read_files,
    read_seed,
    resume_command,
    write_config,
)
from vsearch_jax.runs.interrupts import OnInterrupt, call_interruptibly, stop_on_signal
from vsearch_jax.runs.metrics_log import STAGES, MetricsLine, MetricsLog, read_metrics
from vsearch_jax.scene import check_unchanged, scene_fingerprint
from vsearch_jax.training import init, train
from vsearch_jax.types import ReachabilityMap, TrainState

OnChunk = Callable[[int, float, Sequence[MetricsLine]], None]
"""(number of iterations done, wall time of the chunk in s, the chunk's lines of `metrics.jsonl`) -> None."""


def _ignore(*_: object) -> None:
    """Does nothing."""


def start_run(run: Path, config: Config, seed: int) -> TrainState:
    """Starts a new run: makes its folder, computes the untrained state, and saves this state as the first checkpoint.

    If this fails, nothing is left of the folder; a folder that was there before is empty again.

    Args:
      run: folder of the run; a folder that does not exist yet, or an empty one.
      config: the run's config.
      seed: seed of all random numbers of the run, from 0 to `MAX_SEED`.

    Returns:
      The state before any training.

    Raises:
      RunError: the folder is not empty.
      ConfigError: the seed is out of range, or the arm cannot reach the target view.
      SceneError: the arm or the object cannot be loaded.
      OSError: the disk is full or not writable.
    """
    if not 0 <= seed <= MAX_SEED:
        raise ConfigError(f"`seed` is {seed}; allowed: 0 to {MAX_SEED}")
    with new_run_folder(run):
        files = scene_fingerprint(config.scene, config.env)
        state = call_interruptibly(init, jax.random.key(seed), config)
        # Only the evaluation needs the target. Checked here, the error comes before the training, not after it.
        check_target(state.reach, config)
        write_config(run, config, seed, files)
        checkpoint.save(run, state, config)
    return state


def resume_run(run: Path, config: Config) -> TrainState:
    """Loads the state from which an interrupted run continues: the run's last checkpoint.

    Args:
      run: folder of the run.
      config: the run's config. Fields that only the evaluation reads may differ; then `config.json` is written again.

    Returns:
      The state of the last checkpoint.

    Raises:
      RunError: the folder holds no run.
      SceneError: a file of the scene has changed since the run was started.
      CheckpointError: the checkpoint is missing, damaged, or belongs to another config or version.
      ConfigError: the arm cannot reach the target view.
    """
    saved, seed, files = read_config(run), read_seed(run), read_files(run)
    check_unchanged(saved.scene, saved.env, files)
    template = jax.eval_shape(lambda key: init(key, config), jax.random.key(0))
    state = checkpoint.restore(run, template, config)
    check_target(state.reach, config)
    if saved != config:
        write_config(run, config, seed, files)
    return state


def train_to_end(
    run: Path,
    state: TrainState,
    config: Config,
    on_chunk: OnChunk = _ignore,
    on_interrupt: OnInterrupt = _ignore,
) -> TrainState:
    """Trains to the end of the run, and saves a checkpoint after each chunk of iterations.

    At a first SIGINT or SIGTERM the running chunk ends and is saved. A second signal stops at once.

    Args:
      run: folder of the run.
      state: from `start_run` or `resume_run`. The state is donated, so it cannot be used again.
      config: the run's config.
      on_chunk: called after each chunk is saved.
      on_interrupt: called at the first signal.

    Returns:
      The state at the end of the run.

    Raises:
      KeyboardInterrupt: a signal stopped the run. The last checkpoint holds the saved iterations.
      RunError: the training diverged, or `metrics.jsonl` is damaged.
      OSError: the disk is full or not writable. The last checkpoint stays.
    """
    with stop_on_signal(on_interrupt) as stop_requested:
        return _train_chunks(run, state, config, on_chunk, stop_requested)


def _train_chunks(
    run: Path, state: TrainState, config: Config, on_chunk: OnChunk, stop_requested: threading.Event
) -> TrainState:
    step = int(state.step)
    with contextlib.closing(MetricsLog(run, step)) as log:
        while step < config.num_iterations:
            start_time = time.perf_counter()
            state, metrics = call_interruptibly(train, state, config)
            seconds = time.perf_counter() - start_time
            new_step = int(state.step)
            # The last chunk may be shorter than its arrays.
            columns = {name: np.asarray(column)[: new_step - step] for name, column in metrics.items()}
            check_finite(run, columns, step, config)
            log.append(columns, step, seconds)
            checkpoint.save(run, state, config)
            on_chunk(new_step, seconds, log.lines[step - new_step :])
            step = new_step
            if stop_requested.is_set():
                raise KeyboardInterrupt
    return state


def check_finite(run: Path, columns: Mapping[str, np.ndarray], step: int, config: Config) -> None:
    """Checks that losses and rewards of a chunk of n iterations are finite. Called before the chunk is saved.

    Args:
      run: folder of the run, for the error message.
      columns: f32[n] for each metric of the chunk, one value for each iteration.
      step: number of the chunk's first iteration.
      config: the run's config.

    Raises:
      RunError: the training diverged.
    """
    number = step + np.arange(len(columns["stage"])) - config.encoder.num_updates
    is_encoder, is_policy = number < 0, number >= 0
    is_updated = number * config.sac.num_envs >= config.sac.num_warmup_steps
    rows_of_metric = {
        "encoder_loss": is_encoder,
        "reward": is_policy,
        "critic_loss": is_updated,
        "actor_loss": is_updated,
    }
    for name, rows in rows_of_metric.items():
        if not np.isfinite(columns[name][rows]).all():
            section = "EncoderConfig" if name == "encoder_loss" else "SACConfig"
            raise RunError(
                f"{run}: the training diverged: {name} is not finite in the chunk that starts at iteration {step}, "
                f"which is not saved; start a new run with a smaller {section}.learning_rate"
            )


class Evaluated(NamedTuple):
    """Everything that the report of a run needs.

    Attributes:
      arrays: measures of each searcher, from `evaluate`.
      search: images of one search, from `record_search`, as numpy arrays.
      reach: the views that the arm reaches.
      lines: lines of `metrics.jsonl`.
      wall_seconds: wall time in s of each stage of the run.
      seed: the run's seed.
    """

    arrays: dict[str, Outcome]
    search: dict[str, np.ndarray]
    reach: ReachabilityMap
    lines: list[MetricsLine]
    wall_seconds: dict[str, float]
    seed: int


def evaluate_run(run: Path, state: TrainState, config: Config) -> Evaluated:
    """Evaluates a finished run: measures all searchers, and records the images of one search.

    Args:
      run: folder of the run.
      state: the run's last state.
      config: the run's config, or a changed one: the fields that `evaluate` names may differ from the stored config.

    Returns:
      The measures, the recorded search, and the metrics of the training.

    Raises:
      RunError: the run is not finished.
      ConfigError: the arm cannot reach the target view.
    """
    check_finished(run, state, config)
    lines, seed = read_metrics(run), read_seed(run)
    release_memory()  # The compiled training holds some GiB.
    start_time = time.perf_counter()
    arrays = call_interruptibly(evaluate, state, config)
    wall_seconds: dict[str, float] = {
        stage: sum(line["seconds"] for line in lines if line["stage"] == stage) for stage in STAGES
    }
    wall_seconds["evaluation"] = time.perf_counter() - start_time
    search = jax.tree.map(np.asarray, call_interruptibly(record_search, state, config))
    return Evaluated(arrays, search, state.reach, lines, wall_seconds, seed)


def check_finished(run: Path, state: TrainState, config: Config) -> None:
    """Checks that the training of a run is finished: all iterations of the config are done.

    Args:
      run: folder of the run, for the error message.
      state: the run's last state.
      config: the run's config.

    Raises:
      RunError: the run is not finished.
    """
    step, num_iterations = int(state.step), config.num_iterations
    if step < num_iterations:
        raise RunError(f"{run} has done {step} of {num_iterations} iterations; finish the run: {resume_command(run)}")


def release_memory() -> None:
    """Deletes all programs that JAX has compiled, and returns the memory to the operating system.

    The GNU C library keeps freed memory until it is asked to return it. With another C library this step is skipped.
    """
    jax.clear_caches()
    gc.collect()
    with contextlib.suppress(AttributeError, OSError):
        ctypes.CDLL(None).malloc_trim(0)
