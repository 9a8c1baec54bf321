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
from vsearch_jax.env.examples import (
    AUGMENTED,
    CLEAN,
    SHADED,
    EncoderExample,
    encoder_example,
    random_disturbances,
    random_example_views,
)
from vsearch_jax.env.parts import TaskParts, build_parts, check_jax_settings
from vsearch_jax.env.task import ViewSearchEnv

__all__ = [
    "AUGMENTED",
    "CLEAN",
    "FALSE_POSITIVE_DEG",
    "SHADED",
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
    "random_disturbances",
    "random_example_views",
    "step_reward",
    "zero_observation",
]
