"""The view-search task (thesis 4.3) as a `brax.envs.Env`."""

from vsearch_jax.env.episode import (
    UnreachableError,
    build_obs,
    check_band,
    episode_of,
    obs_of,
    pose_error,
    step_reward,
    zero_observation,
)
from vsearch_jax.env.examples import encoder_example
from vsearch_jax.env.task import ViewSearchEnv

__all__ = [
    "UnreachableError",
    "ViewSearchEnv",
    "build_obs",
    "check_band",
    "encoder_example",
    "episode_of",
    "obs_of",
    "pose_error",
    "step_reward",
    "zero_observation",
]
