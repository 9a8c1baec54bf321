"""The view-search task (thesis 4.3) as a `brax.envs.Env`."""

from vsearch_jax.env.episode import (
    FALSE_POSITIVE_DEG,
    UnreachableError,
    build_obs,
    check_band,
    episode_of,
    obs_of,
    pose_error,
    protocol_target,
    step_reward,
    zero_observation,
)
from vsearch_jax.env.examples import EncoderExample, encoder_example, random_example_views
from vsearch_jax.env.task import ViewSearchEnv

__all__ = [
    "FALSE_POSITIVE_DEG",
    "EncoderExample",
    "UnreachableError",
    "ViewSearchEnv",
    "build_obs",
    "check_band",
    "encoder_example",
    "episode_of",
    "obs_of",
    "pose_error",
    "protocol_target",
    "random_example_views",
    "step_reward",
    "zero_observation",
]
