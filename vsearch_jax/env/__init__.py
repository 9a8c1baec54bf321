"""The view-search task (thesis 4.3) behind brax's interface."""

from vsearch_jax.env.episode import UnreachableError, build_obs, check_band, episode_of, pose_error
from vsearch_jax.env.task import ViewSearchEnv

__all__ = ["UnreachableError", "ViewSearchEnv", "build_obs", "check_band", "episode_of", "pose_error"]
