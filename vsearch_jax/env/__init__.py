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
from vsearch_jax.env.parts import TaskParts, build_parts, check_jax_settings
from vsearch_jax.env.task import ViewSearchEnv

__all__ = [
    "FALSE_POSITIVE_DEG",
    "EncoderExample",
    "TaskParts",
    "UnreachableError",
    "ViewSearchEnv",
    "build_obs",
    "build_parts",
    "check_band",
    "check_jax_settings",
    "encoder_example",
    "episode_of",
    "obs_of",
    "pose_error",
    "protocol_target",
    "random_example_views",
    "step_reward",
    "zero_observation",
]
