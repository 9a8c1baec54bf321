"""brax's own trainer on the environment, neither changed."""

import functools

import jax
import numpy as np
import pytest

import vsearch_jax as vs

CONFIG = vs.Config.preset("smoke")


@pytest.mark.slow  # brax compiles the environment for each of its programs: minutes
@pytest.mark.brax_trainer
@pytest.mark.filterwarnings("ignore:jax.device_put_replicated is deprecated:DeprecationWarning")
def test_braxs_own_sac_trains_on_it():
    from brax.training.agents.sac import train as brax_sac

    seen = []
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
        progress_fn=lambda steps, metrics: seen.append((steps, metrics["eval/episode_reward"])),
    )
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):  # as brax computes
        _, params, _ = train()
    assert seen[-1][0] >= 2000
    assert all(np.isfinite(reward) for _, reward in seen)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(params))
