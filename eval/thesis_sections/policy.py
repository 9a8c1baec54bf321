"""The thesis's soft actor-critic (algorithm 2): value network, fixed temperature, one target, 11,000 steps."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np

import vsearch_jax as vs
from vsearch_jax import runs
from vsearch_jax.config import Config, EvaluationConfig
from vsearch_jax.training import with_encoder
from vsearch_jax.types import TrainState, View

NUM_EPISODES = 100


def thesis_config(config: Config, is_quick: bool) -> Config:
    """Returns the config of the thesis's policies.

    The thesis gives neither the temperature nor the sizes of networks and batches. They are ours.

    Args:
      config: the config of the run that gives the encoder.
      is_quick: whether to train only for as long as a test needs.
    """
    steps = 64 if is_quick else 11_000
    policy = dataclasses.replace(
        config.sac,
        algorithm="value",
        num_envs=8,
        num_environment_steps=steps,
        num_warmup_steps=16 if is_quick else 504,
        updates_per_step=1.0,
        initial_temperature=0.05,
        network="plain",
        pool_fraction=0.0,
        relabel_fraction=0.0,
    )
    episodes = 8 if is_quick else NUM_EPISODES
    evaluation = dataclasses.replace(
        EvaluationConfig(),
        target_azimuth_deg=config.evaluation.target_azimuth_deg,
        target_elevation_deg=config.evaluation.target_elevation_deg,
        num_initial_views=4,
        num_runs=1,
        num_episodes=episodes,
        batch_size=episodes,
    )
    task = dataclasses.replace(config.env, target="fixed")
    num_chunks = 4 if is_quick else 20
    return dataclasses.replace(config, sac=policy, env=task, evaluation=evaluation, num_chunks=num_chunks)


def train_policies(run: Path, encoder_of: TrainState, config: Config, seed: int) -> TrainState:
    """Trains the thesis's policies with the encoder of another run, or continues an interrupted training.

    Args:
      run: folder of the training.
      encoder_of: trained state that has the encoder.
      config: from `thesis_config`.
      seed: seed of all random numbers.

    Returns:
      The state at the end.
    """
    if runs.latest_step(run) is None:
        state = with_encoder(runs.start_run(run, config, seed), encoder_of.encoder, config)
    else:
        state = runs.resume_run(run, config)
        if int(state.step) == 0:  # stopped before the encoder was in place
            state = with_encoder(state, encoder_of.encoder, config)
    return runs.train_to_end(run, state, config)


def evaluate_policies(state: TrainState, config: Config) -> dict[str, np.ndarray]:
    """Evaluates the thesis's policies: returns measures by name, arrays of [policy seeds, episodes].

    Args:
      state: from `train_policies`.
      config: from `thesis_config`.
    """
    outcome = vs.evaluate(state, config)["sac"]
    return {name: np.asarray(x) for name, x in outcome.items() if not isinstance(x, View)}
