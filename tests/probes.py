"""Problems whose optimum is known in closed form, for the searchers and for soft actor-critic."""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
from brax.envs.base import Env, State
from jax import Array

from vsearch_jax.config import EnvConfig
from vsearch_jax.geometry import cosine_similarity, wrap_angle
from vsearch_jax.search import SearchArgs
from vsearch_jax.types import Camera, EpisodeState, Observation, View

BAND = (math.radians(40.0), math.radians(70.0))
THRESHOLD = 0.98


def direction(view: View) -> Array:
    cos_elevation = jnp.cos(view.elevation)
    return jnp.stack(
        [cos_elevation * jnp.cos(view.azimuth), cos_elevation * jnp.sin(view.azimuth), jnp.sin(view.elevation)]
    )


def angle_between(a: View, b: View) -> Array:
    return jnp.arctan2(jnp.linalg.norm(jnp.cross(direction(a), direction(b))), jnp.dot(direction(a), direction(b)))


def opposite(view: View) -> View:
    return View(wrap_angle(view.azimuth + jnp.pi), view.elevation)


def two_peaks(view: View, target: View) -> Array:
    """1 at the target, 0.43 at the view opposite, where the thesis's searches get stuck; 0.1 far from both."""
    width = math.radians(35.0)
    peak = 0.9 * jnp.exp(-((angle_between(view, target) / width) ** 2))
    false_peak = 0.33 * jnp.exp(-((angle_between(view, opposite(target)) / width) ** 2))
    return 0.1 + jnp.maximum(peak, false_peak)


def unreachable_outside_band(view: View, target: View) -> Array:
    is_inside = (view.elevation >= BAND[0]) & (view.elevation <= BAND[1])
    return jnp.where(is_inside, two_peaks(view, target), -jnp.inf)


def never_reachable(view: View, target: View) -> Array:
    del view, target
    return jnp.asarray(-jnp.inf)


def random_views(key: Array, num: int) -> View:
    azimuth_key, elevation_key = jax.random.split(key)
    return View(
        jax.random.uniform(azimuth_key, (num,), minval=-jnp.pi, maxval=jnp.pi),
        jax.random.uniform(elevation_key, (num,), minval=BAND[0], maxval=BAND[1]),
    )


def search_problems(initial: View, target: View) -> SearchArgs:
    """Problems of View f32[N] -> View f32[N] on the sphere's band, batched."""
    num = initial.azimuth.shape[0]
    return SearchArgs(
        initial=initial, band=jnp.tile(jnp.asarray(BAND), (num, 1)), threshold=jnp.full((num,), THRESHOLD), task=target
    )


def no_motion() -> dict[str, Array]:
    """The metrics of an arm that is everywhere at once."""
    return {"joint_travel": jnp.zeros(()), "motion_time": jnp.zeros(())}


class SphereEnv(Env):
    """View search with codes whose cosine is a product of two known kernels, so that the steps needed are known.

    cosine = k(azimuth difference) (1 + 2 cos(3 elevation difference)) / 3, with k a wrapped bell of 22 degrees.
    """

    orders = tuple(range(8))
    elevation_rate = 3.0

    def __init__(self, config: EnvConfig) -> None:
        self.config = config
        bell = jnp.exp(-0.5 * (jnp.asarray(self.orders, jnp.float32) * math.radians(22.0)) ** 2)
        bell = bell.at[0].multiply(0.5)
        self.weights = bell / bell.sum()

    @property
    def observation_size(self) -> int:
        return 2 * 48 + 2

    @property
    def action_size(self) -> int:
        return 2

    @property
    def backend(self) -> str:
        return "none"

    def azimuth_kernel(self, difference: Array) -> Array:
        orders = jnp.asarray(self.orders, jnp.float32)
        return jnp.sum(self.weights * jnp.cos(orders * difference))

    def basin(self) -> tuple[float, float]:
        """Half widths in rad of the threshold's region along each axis."""
        steps = jnp.radians(jnp.arange(0.0, 30.0, 0.05))
        inside = jax.vmap(self.azimuth_kernel)(steps) >= self.config.threshold
        azimuth = float(steps[int(inside.sum()) - 1])
        return azimuth, math.acos((3.0 * self.config.threshold - 1.0) / 2.0) / self.elevation_rate

    def code(self, view: View) -> Array:
        orders = jnp.asarray(self.orders, jnp.float32)
        waves = jnp.concatenate([jnp.cos(orders * view.azimuth), jnp.sin(orders * view.azimuth)])
        azimuth = waves * jnp.sqrt(jnp.tile(self.weights, 2))
        angle = self.elevation_rate * view.elevation
        elevation = jnp.stack([jnp.ones(()), jnp.sqrt(2.0) * jnp.cos(angle), jnp.sqrt(2.0) * jnp.sin(angle)])
        code = jnp.outer(azimuth, elevation / math.sqrt(3.0)).reshape(-1)
        return code * math.sqrt(code.size)  # norm 1 becomes mean square 1

    def observe_view(self, view: View) -> Observation:
        camera = Camera(position=direction(view), rotation=jnp.eye(3), fovy=jnp.ones(()))
        return Observation(
            view=view, qpos=jnp.stack([view.azimuth, view.elevation]), camera=camera, code=self.code(view)
        )

    def reset(self, rng: Array) -> State:
        initial, target = (jax.tree.map(lambda x: x[0], random_views(key, 1)) for key in jax.random.split(rng))
        return self.start(self.observe_view(initial), self.observe_view(target))

    def start(self, observation: Observation, target: Observation) -> State:
        zero = jnp.zeros(())
        info = {"terminated": zero, "truncated": zero, "is_reachable": jnp.ones(())}
        metrics = {"similarity": cosine_similarity(observation.code, target.code)} | no_motion()
        episode = EpisodeState(observation=observation, target=target, num_steps=jnp.zeros((), jnp.int32))
        return State(episode, self.observe(episode), zero, zero, metrics, info)

    def observe(self, episode: EpisodeState) -> Array:
        return jnp.concatenate([episode.observation.code, episode.target.code, episode.observation.qpos])

    def step(self, state: State, action: Array) -> State:
        episode = state.pipeline_state
        delta = action * math.radians(self.config.action_scale_deg)
        old = episode.observation
        view = View(wrap_angle(old.view.azimuth + delta[0]), old.view.elevation + delta[1])
        is_reachable = (view.elevation >= BAND[0]) & (view.elevation <= BAND[1])
        observation = jax.tree.map(lambda new, stay: jnp.where(is_reachable, new, stay), self.observe_view(view), old)
        similarity = cosine_similarity(observation.code, episode.target.code)
        is_found = is_reachable & (similarity >= self.config.threshold)
        reward = jnp.where(is_found, self.config.success_reward, similarity - 1.0)
        reward = jnp.where(is_reachable, reward, self.config.unreachable_reward)
        num_steps = episode.num_steps + 1
        info = {
            "terminated": is_found.astype(jnp.float32),
            "truncated": ((num_steps >= self.config.episode_length) & ~is_found).astype(jnp.float32),
            "is_reachable": is_reachable.astype(jnp.float32),
        }
        episode = EpisodeState(observation=observation, target=episode.target, num_steps=num_steps)
        return State(
            episode, self.observe(episode), reward, info["terminated"], {"similarity": similarity} | no_motion(), info
        )

    def steps_lower_bound(self, initial: View, target: View) -> Array:
        azimuth_width, elevation_width = self.basin()
        azimuth = jnp.abs(wrap_angle(target.azimuth - initial.azimuth)) - azimuth_width
        elevation = jnp.abs(target.elevation - initial.elevation) - elevation_width
        steps = jnp.maximum(azimuth, elevation) / math.radians(self.config.action_scale_deg)
        return jnp.maximum(jnp.ceil(steps), 1.0)
