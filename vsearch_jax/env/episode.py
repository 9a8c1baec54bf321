"""What an episode carries, and how far its views are from the target's."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from brax.envs.base import State
from jax import Array
from jax.core import Tracer

from vsearch_jax.config import Config, ConfigError
from vsearch_jax.geometry import frobenius_angle, rotation_error
from vsearch_jax.types import Camera, EpisodeState, ReachabilityMap


class UnreachableError(ConfigError):
    """The arm does not reach the views that are wanted.

    Attributes:
      reach: the arm's reachability map.
    """

    def __init__(self, message: str, reach: ReachabilityMap) -> None:
        """Keeps the map beside the message."""
        super().__init__(message)
        self.reach = reach


def check_band(reach: ReachabilityMap, config: Config) -> None:
    """Checks that there is a band to search; does nothing under a trace.

    Raises:
      ConfigError: the arm reaches no elevation at every azimuth.
    """
    if not isinstance(reach.band, Tracer) and np.isnan(reach.band).any():
        raise UnreachableError(
            f"arm {config.scene.arm!r} at SceneConfig.mount_height {config.scene.mount_height:g} reaches no elevation "
            f"at every azimuth around object {config.scene.object!r}; `vsearch reach` draws what it does reach, and "
            "proposes a mount_height",
            reach,
        )


def episode_of(state: State) -> EpisodeState:
    """Returns the episode that a brax State carries."""
    return state.pipeline_state  # pyright: ignore[reportReturnType] # brax lets any pytree stand here


def build_obs(episode: EpisodeState) -> Array:
    """Returns the observation: code, target code, joints."""
    return jnp.concatenate([episode.observation.code, episode.target.code, episode.observation.qpos])


def pose_error(camera: Camera, target: Camera) -> tuple[Array, Array, Array]:
    """Returns rotation error in rad, formula 3.2 of the thesis in rad, and translation error in m."""
    translation = jnp.sqrt(jnp.sum((camera.position - target.position) ** 2, axis=-1))
    rotations = (camera.rotation, target.rotation)
    return rotation_error(*rotations), frobenius_angle(*rotations), translation
