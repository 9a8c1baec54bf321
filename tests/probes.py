"""Search problems with a known optimum, for the searchers and for soft actor-critic."""

from __future__ import annotations

import math
from typing import cast

import jax
import jax.numpy as jnp
from brax import base
from brax.envs.base import Env, State
from jax import Array

from vsearch_jax.config import EnvConfig
from vsearch_jax.env import episode_of
from vsearch_jax.geometry import cosine_similarity, wrap_angle
from vsearch_jax.search import SearchArgs
from vsearch_jax.types import Camera, EpisodeState, Observation, View
from vsearch_jax.xla.tree import tree_where

BAND = (math.radians(40.0), math.radians(70.0))
THRESHOLD = 0.98


def direction(view: View) -> Array:
    """Returns f32[3], the unit vector from the object to the view."""
    cos_elevation = jnp.cos(view.elevation)
    return jnp.stack(
        [cos_elevation * jnp.cos(view.azimuth), cos_elevation * jnp.sin(view.azimuth), jnp.sin(view.elevation)]
    )


def angle_between(a: View, b: View) -> Array:
    """Returns f32[] rad, the angle between two views as seen from the object."""
    return jnp.arctan2(jnp.linalg.norm(jnp.cross(direction(a), direction(b))), jnp.dot(direction(a), direction(b)))


def opposite(view: View) -> View:
    """Returns the view on the other side of the object, at the same elevation."""
    return View(wrap_angle(view.azimuth + jnp.pi), view.elevation)


def two_peaks(view: View, target: View) -> Array:
    """Returns the score: 1 at the target, 0.43 at the opposite view, 0.1 far from both.

    The searches of the thesis get stuck at the opposite view.
    """
    width = math.radians(35.0)
    peak = 0.9 * jnp.exp(-((angle_between(view, target) / width) ** 2))
    false_peak = 0.33 * jnp.exp(-((angle_between(view, opposite(target)) / width) ** 2))
    return 0.1 + jnp.maximum(peak, false_peak)


def unreachable_outside_band(view: View, target: View) -> Array:
    """Returns the score of `two_peaks` inside the band, -inf outside."""
    is_inside = (view.elevation >= BAND[0]) & (view.elevation <= BAND[1])
    return jnp.where(is_inside, two_peaks(view, target), -jnp.inf)


def never_reachable(view: View, target: View) -> Array:
    """Returns -inf, the score of an unreachable view."""
    del view, target
    return jnp.asarray(-jnp.inf)


def random_views(key: Array, num: int) -> View:
    """Returns View of f32[num] rad, uniformly random inside the band."""
    azimuth_key, elevation_key = jax.random.split(key)
    return View(
        jax.random.uniform(azimuth_key, (num,), minval=-jnp.pi, maxval=jnp.pi),
        jax.random.uniform(elevation_key, (num,), minval=BAND[0], maxval=BAND[1]),
    )


def search_problems(initial: View, target: View) -> SearchArgs[View]:
    """Returns SearchArgs with leading axis N for initial views and targets, each View of f32[N] rad."""
    num = initial.azimuth.shape[0]
    return SearchArgs(
        initial=initial, band=jnp.tile(jnp.asarray(BAND), (num, 1)), threshold=jnp.full((num,), THRESHOLD), task=target
    )


def as_pipeline_state(episode: EpisodeState) -> base.State:
    """Returns `episode` with the type that brax declares. brax never reads it and accepts any pytree."""
    return cast(base.State, episode)


class SphereEnv(Env):
    """View search with codes whose cosine is a product of two known kernels. So the number of steps needed is known.

    cosine = k(azimuth difference) (1 + 2 cos(3 elevation difference)) / 3, where k is a wrapped bell of 22 degrees.
    """

    orders = tuple(range(8))
    elevation_rate = 3.0

    def __init__(self, config: EnvConfig) -> None:
        """Computes the weights of the azimuth kernel's cosine series."""
        self.config = config
        bell = jnp.exp(-0.5 * (jnp.asarray(self.orders, jnp.float32) * math.radians(22.0)) ** 2)
        bell = bell.at[0].multiply(0.5)
        self.weights = bell / bell.sum()

    @property
    def observation_size(self) -> int:
        """Number of entries in an obs: code, target code, azimuth and elevation."""
        return 2 * 48 + 2

    @property
    def action_size(self) -> int:
        """Number of entries in an action."""
        return 2

    @property
    def backend(self) -> str:
        """Name of brax's physics; unused."""
        return "none"

    def azimuth_kernel(self, difference: Array) -> Array:
        """Returns f32[], the factor of the cosine that depends on the azimuth difference (f32[] rad)."""
        orders = jnp.asarray(self.orders, jnp.float32)
        return jnp.sum(self.weights * jnp.cos(orders * difference))

    def success_half_widths(self) -> tuple[float, float]:
        """Returns the largest azimuth and elevation differences in rad, each alone, that meet the threshold."""
        angles = jnp.radians(jnp.arange(0.0, 30.0, 0.05))
        inside = jax.vmap(self.azimuth_kernel)(angles) >= self.config.threshold
        azimuth = float(angles[int(inside.sum()) - 1])
        return azimuth, math.acos((3.0 * self.config.threshold - 1.0) / 2.0) / self.elevation_rate

    def code(self, view: View) -> Array:
        """Returns f32[48], the code of a view."""
        orders = jnp.asarray(self.orders, jnp.float32)
        waves = jnp.concatenate([jnp.cos(orders * view.azimuth), jnp.sin(orders * view.azimuth)])
        azimuth = waves * jnp.sqrt(jnp.tile(self.weights, 2))
        angle = self.elevation_rate * view.elevation
        elevation = jnp.stack([jnp.ones(()), jnp.sqrt(2.0) * jnp.cos(angle), jnp.sqrt(2.0) * jnp.sin(angle)])
        code = jnp.outer(azimuth, elevation / math.sqrt(3.0)).reshape(-1)
        return code * math.sqrt(code.size)  # a real code has mean square 1, not norm 1

    def observe_view(self, view: View) -> Observation:
        """Returns the Observation from a view. Azimuth and elevation stand in for the joint values."""
        camera = Camera(position=direction(view), rotation=jnp.eye(3), fovy=jnp.ones(()))
        return Observation(
            view=view, qpos=jnp.stack([view.azimuth, view.elevation]), camera=camera, code=self.code(view)
        )

    def reset(self, rng: Array) -> State:
        """Starts an episode with a random initial view and a random target."""
        initial, target = (jax.tree.map(lambda x: x[0], random_views(key, 1)) for key in jax.random.split(rng))
        observation, target_observation = self.observe_view(initial), self.observe_view(target)
        episode = EpisodeState(observation, target_observation, num_steps=jnp.zeros((), jnp.int32))
        zero = jnp.zeros(())
        info = {"terminated": zero, "truncated": zero, "is_reachable": jnp.ones(())}
        return State(as_pipeline_state(episode), self._obs(episode), zero, zero, self._metrics(episode), info)

    def step(self, state: State, action: Array) -> State:
        """Changes the view by `action`, as `ViewSearchEnv.step` does."""
        episode = episode_of(state)
        delta = action * math.radians(self.config.action_scale_deg)
        old = episode.observation
        view = View(wrap_angle(old.view.azimuth + delta[0]), old.view.elevation + delta[1])
        is_reachable = (view.elevation >= BAND[0]) & (view.elevation <= BAND[1])
        observation = tree_where(is_reachable, self.observe_view(view), old)
        episode = EpisodeState(observation, episode.target, num_steps=episode.num_steps + 1)
        metrics = self._metrics(episode)
        is_found = is_reachable & (metrics["similarity"] >= self.config.threshold)
        reward = jnp.where(is_found, self.config.success_reward, metrics["similarity"] - 1.0)
        reward = jnp.where(is_reachable, reward, self.config.unreachable_reward)
        info = {
            "terminated": is_found.astype(jnp.float32),
            "truncated": ((episode.num_steps >= self.config.episode_length) & ~is_found).astype(jnp.float32),
            "is_reachable": is_reachable.astype(jnp.float32),
        }
        pipeline_state = as_pipeline_state(episode)
        return State(pipeline_state, self._obs(episode), reward, info["terminated"], metrics, info)

    def _obs(self, episode: EpisodeState) -> Array:
        return jnp.concatenate([episode.observation.code, episode.target.code, episode.observation.qpos])

    def _metrics(self, episode: EpisodeState) -> dict[str, Array]:
        """Returns the metrics. Motions take neither travel nor time."""
        similarity = cosine_similarity(episode.observation.code, episode.target.code)
        return {"similarity": similarity, "joint_travel": jnp.zeros(()), "motion_time": jnp.zeros(())}

    def steps_lower_bound(self, initial: View, target: View) -> Array:
        """Returns f32[], a lower bound on the number of steps from `initial` to a view that meets the threshold."""
        azimuth_width, elevation_width = self.success_half_widths()
        azimuth = jnp.abs(wrap_angle(target.azimuth - initial.azimuth)) - azimuth_width
        elevation = jnp.abs(target.elevation - initial.elevation) - elevation_width
        steps = jnp.maximum(azimuth, elevation) / math.radians(self.config.action_scale_deg)
        return jnp.maximum(jnp.ceil(steps), 1.0)
