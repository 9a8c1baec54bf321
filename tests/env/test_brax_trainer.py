"""brax's own SAC trainer runs on the environment without changes to either."""

import functools

import jax
import numpy as np
import pytest

import vsearch_jax as vs

CONFIG = vs.Config.preset("smoke")


@pytest.mark.slow  # brax compiles the environment several times, which takes minutes.
@pytest.mark.brax_trainer
@pytest.mark.filterwarnings("ignore:jax.device_put_replicated is deprecated:DeprecationWarning")
def test_sac_trainer_of_brax_runs_on_the_environment():
    from brax.training.agents.sac import train as brax_sac

    progress = []
    train = functools.partial(
        brax_sac.train,
        vs.ViewSearchEnv(CONFIG),
        num_timesteps=2000,
        episode_length=CONFIG.env.episode_length,
        num_envs=16,
        num_eval_envs=16,
        num_evals=1,
        min_replay_size=256,
        grad_updates_per_step=4,
        batch_size=64,
        progress_fn=lambda steps, metrics: progress.append((steps, metrics["eval/episode_reward"])),
    )
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):  # brax relies on both.
        _, params, _ = train()
    assert progress[-1][0] >= 2000
    assert all(np.isfinite(reward) for _, reward in progress)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(params))
