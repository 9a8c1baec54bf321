"""The view-search task (thesis 4.3) behind brax's interface."""

from vsearch_jax.env.episode import UnreachableError, check_band, episode_of, observe, pose_error
from vsearch_jax.env.task import ViewSearchEnv

__all__ = ["UnreachableError", "ViewSearchEnv", "check_band", "episode_of", "observe", "pose_error"]
