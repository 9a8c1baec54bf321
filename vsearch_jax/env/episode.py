"""State of an episode, the policy's input, the reward, and the errors of a view."""

from __future__ import annotations

import dataclasses
import math
from typing import cast

import jax.numpy as jnp
import numpy as np
from brax import base
from brax.envs.base import State
from jax import Array
from jax.core import Tracer

from vsearch_jax.config import Config, ConfigError, EnvConfig
from vsearch_jax.geometry import (
    cosine_similarity,
    frobenius_angle,
    rotation_error,
    symmetric_turn,
    turn_about_z,
    wrap_angle,
)
from vsearch_jax.planning import Motion
from vsearch_jax.robot.blocking import describe_blocking_contacts
from vsearch_jax.scene import build_scene
from vsearch_jax.types import Camera, EpisodeState, Observation, ReachabilityMap, View
from vsearch_jax.xla.tree import tree_where

FALSE_POSITIVE_DEG = 10.0
"""A found view is a false positive if its rotation error is larger than this (thesis 3.6)."""


class UnreachableError(ConfigError):
    """The arm does not reach the views that the config asks for.

    Attributes:
      reach: ReachabilityMap of the arm.
    """

    def __init__(self, message: str, reach: ReachabilityMap) -> None:
        """Stores the map beside the message."""
        super().__init__(message)
        self.reach = reach


def check_band(reach: ReachabilityMap, config: Config) -> None:
    """Checks that there is a band to search: elevations that the arm reaches at every azimuth.

    Does nothing while JAX traces, because values are unknown then.

    Args:
      reach: the views that the arm reaches.
      config: the run's config. The error names the arm, mount height and object of this config.

    Raises:
      UnreachableError: there is no elevation that the arm reaches at every azimuth.
    """
    if not isinstance(reach.band, Tracer) and np.isnan(reach.band).any():
        raise UnreachableError(
            f"arm {config.scene.arm!r} at SceneConfig.mount_height {config.scene.mount_height:g} reaches no elevation "
            f"at every azimuth around object {config.scene.object!r}; run `vsearch reach`: it draws the views that the "
            "arm reaches and proposes a mount height (SceneConfig.mount_height)"
            f"{describe_blocking_contacts(build_scene(config.scene))}",
            reach,
        )


def episode_of(state: State) -> EpisodeState:
    """Returns what a brax State stores of the episode: present observation, target observation and step count."""
    # brax declares its own physics state here, but never reads it and accepts any pytree.
    return cast(EpisodeState, state.pipeline_state)


def obs_of(state: State) -> Array:
    """Returns the policy's flat input vector f32[D] that a brax State of this task stores; D is its length."""
    # brax also allows a mapping of arrays; this task never makes one.
    return cast(Array, state.obs)


def build_obs(episode: EpisodeState) -> Array:
    """Builds the policy's flat input vector of D numbers, f32[D]: image code, target's image code, joint values."""
    return jnp.concatenate([episode.observation.code, episode.target.code, episode.observation.qpos])


def zero_observation(code_size: int, num_joint_values: int) -> Observation:
    """Returns an Observation of zeros, which has the shapes of every other one. To trace a real one takes seconds.

    Args:
      code_size: Z, number of entries in a code.
      num_joint_values: nq, number of joint values.
    """
    zero = jnp.zeros(())
    camera = Camera(jnp.zeros(3), jnp.zeros((3, 3)), zero)
    return Observation(View(zero, zero), jnp.zeros(num_joint_values), camera, jnp.zeros(code_size))


def start_state(observation: Observation, target: Observation) -> State:
    """Builds the brax State at the start of an episode.

    Args:
      observation: what the wrist camera sees from the initial view.
      target: what the wrist camera sees from the target view.
    """
    episode = EpisodeState(observation=observation, target=target, num_steps=jnp.zeros((), jnp.int32))
    zero = jnp.zeros(())
    info = {"terminated": zero, "truncated": zero, "is_reachable": jnp.ones(())}
    metrics = {"similarity": cosine_similarity(observation.code, target.code), "unreachable": zero}
    metrics |= {"joint_travel": zero, "motion_time": zero}
    return State(
        pipeline_state=_as_pipeline_state(episode),
        obs=build_obs(episode),
        reward=zero,
        done=zero,
        metrics=metrics,
        info=info,
    )


def next_state(state: State, observation: Observation, motion: Motion, config: EnvConfig) -> State:
    """Builds the brax State after one step from the new observation: reward, termination and metrics.

    Args:
      state: brax State before the step.
      observation: what the wrist camera sees from the commanded view. If `motion` is not found, the arm stays and
        `observation` is ignored.
      motion: cost of the arm's motion to that view, and whether a motion was found.
      config: threshold, rewards and episode length.
    """
    episode = episode_of(state)
    is_reachable = motion.is_found
    observation = tree_where(is_reachable, observation, episode.observation)
    similarity = cosine_similarity(observation.code, episode.target.code)
    reward, is_found = step_reward(similarity, is_reachable, config)
    num_steps = episode.num_steps + 1
    terminated = is_found.astype(jnp.float32)
    truncated = (num_steps >= config.episode_length) & ~is_found
    episode = EpisodeState(observation=observation, target=episode.target, num_steps=num_steps)
    reached = is_reachable.astype(jnp.float32)
    flags = {"terminated": terminated, "truncated": truncated.astype(jnp.float32), "is_reachable": reached}
    info = state.info | flags
    costs = {"joint_travel": motion.travel, "motion_time": motion.duration}
    metrics = state.metrics | {"similarity": similarity, "unreachable": 1.0 - reached} | costs
    return dataclasses.replace(
        state,
        pipeline_state=_as_pipeline_state(episode),
        obs=build_obs(episode),
        reward=reward,
        done=terminated,
        metrics=metrics,
        info=info,
    )


def rest_state(state: State) -> State:
    """Returns the brax State of an episode that is over after one more step: the step earns and costs nothing."""
    nothing = {name: jnp.zeros_like(state.metrics[name]) for name in ("unreachable", "joint_travel", "motion_time")}
    return dataclasses.replace(state, reward=jnp.zeros_like(state.reward), metrics=state.metrics | nothing)


def step_reward(similarity: Array, is_reachable: Array, config: EnvConfig) -> tuple[Array, Array]:
    """Computes the reward of a step, and whether the step finds the target. The arrays may have leading batch axes.

    Args:
      similarity: f32[], cosine of the code after the step and the target's code.
      is_reachable: bool[], the arm reaches the view of the step.
      config: threshold and rewards.

    Returns:
      Reward f32[]; and bool[], the step is reachable and its similarity meets the threshold.
    """
    is_found = is_reachable & (similarity >= config.threshold)
    reward = jnp.where(is_found, config.success_reward, similarity - 1.0)
    return jnp.where(is_reachable, reward, config.unreachable_reward), is_found


def protocol_target(config: Config) -> View:
    """Returns the view that the evaluated random searches and CMA-ES searches look for: a View of f32[] rad.

    With `env.target` "fixed" it is also the target of every episode.

    Args:
      config: the run's config; `evaluation` is read.
    """
    settings = config.evaluation
    return View(wrap_angle(jnp.deg2rad(settings.target_azimuth_deg)), jnp.deg2rad(settings.target_elevation_deg))


def commanded_view(view: View, action: Array, action_scale_deg: float) -> View:
    """Returns the view that an action asks for: the present view plus the action's change. It may be unreachable.

    Args:
      view: the present view (azimuth and elevation), f32[] rad each.
      action: f32[2], change of azimuth and elevation in units of `action_scale_deg`; clipped to [-1, 1].
      action_scale_deg: change in degrees for an action of 1.
    """
    delta = jnp.clip(action, -1.0, 1.0) * math.radians(action_scale_deg)
    return View(wrap_angle(view.azimuth + delta[0]), view.elevation + delta[1])


def pose_error(camera: Camera, target: Camera, symmetry: int = 1, center: Array | None = None) -> tuple[Array, ...]:
    """Computes the rotation and translation errors of a camera pose with respect to a target camera pose.

    The object may be symmetric. Then the errors are those to the nearest pose from which the object looks the same as
    from the target (the convention of the BOP benchmark).

    Args:
      camera: the camera in world; its arrays may have leading batch axes.
      target: the camera in world at the target view.
      symmetry: number of turns about the vertical that map the object to itself; 1 for none, 0 for any turn.
      center: f32[3] m in world, a point on the axis of these turns; needed unless `symmetry` is 1.

    Returns:
      Three f32 arrays with the batch axes: the geodesic rotation error in rad, the rotation error in rad by formula 3.2
      of the thesis, and the translation error in m.
    """
    rotation, position = target.rotation, target.position
    if symmetry != 1:
        assert center is not None
        turn = turn_about_z(symmetric_turn(camera.rotation, rotation, symmetry))
        rotation = turn @ rotation
        position = center + jnp.einsum("...ij,...j->...i", turn, position - center)
    translation = jnp.sqrt(jnp.sum((camera.position - position) ** 2, axis=-1))
    return rotation_error(camera.rotation, rotation), frobenius_angle(camera.rotation, rotation), translation


def _as_pipeline_state(episode: EpisodeState) -> base.State:
    # brax declares its own physics state here, but never reads it and accepts any pytree.
    return cast(base.State, episode)
