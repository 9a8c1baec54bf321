"""One search of a policy with the arm's motions between the views, sampled at the frames of a film."""

from __future__ import annotations

import dataclasses
import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
from brax.envs.base import State
from jax import Array

from vsearch_jax import encoder as encoders
from vsearch_jax import render
from vsearch_jax.config import Config
from vsearch_jax.env import ViewSearchEnv, episode_of
from vsearch_jax.evaluation.recording import first_actor, opposite_start, roll_out, start_episode
from vsearch_jax.evaluation.views import ViewRequest
from vsearch_jax.geometry import cosine_similarity
from vsearch_jax.planning import Trajectory, duration, state_at
from vsearch_jax.planning.execution import pass_through
from vsearch_jax.search import sac
from vsearch_jax.types import Camera, Observation, TrainState, View
from vsearch_jax.xla.batching import map_in_batches

FPS = 25
"""Frames per second."""
MAX_SECONDS = 60
"""Longest motion in s that `FilmedSearch.qpos` can hold. The frames of a longer motion are cut; the search is not."""
_BATCH_SIZE = 4
"""Frames rendered at a time. More take more memory and are not faster."""
_RAYS_PER_SIDE = 3
"""The overview has 3 x 3 rays per pixel."""
_SKY = (0.93, 0.94, 0.96)
"""Background colour of the overview."""


class FilmedSearch(NamedTuple):
    """One search with the arm's motions: T = `episode_length` steps, at most F = `FPS` * `MAX_SECONDS` frames a motion.

    Attributes:
      start_qpos: f32[nq] rad or m, joints at the initial view.
      target: Observation of the target view.
      qpos: f32[T, F, nq] rad or m, joints in each motion, 1, 2, ... F frames after its start. After the end of a motion
        the last joints repeat.
      durations: f32[T] s, duration of each motion; 0 where the arm did not move.
      similarity: f32[T + 1], cosine of each image that the policy took and the target image, the initial view first.
      is_reachable: bool[T], false where the arm could not reach the view and did not move.
      num_steps: i32[], steps done.
      is_found: bool[], whether the last image meets the threshold.
    """

    start_qpos: Array
    target: Observation
    qpos: Array
    durations: Array
    similarity: Array
    is_reachable: Array
    num_steps: Array
    is_found: Array


class Frames(NamedTuple):
    """Rendered images and measures of N frames.

    Attributes:
      overview: u8[N, H, W, 3], image of the overview camera.
      wrist: u8[N, h, w, 3], image of the wrist camera.
      similarity: f32[N], cosine of wrist image and target image.
      view: View of f32[N] rad, true direction of the wrist camera from the centre of the view sphere.
    """

    overview: Array
    wrist: Array
    similarity: Array
    view: View


@functools.partial(jax.jit, static_argnames="config")
def record_motions(state: TrainState, key: Array | None, config: Config) -> FilmedSearch:
    """Runs one search by the run's first policy, and records the arm's joint values at each frame of the film.

    Args:
      state: a trained state.
      key: PRNG key of a random initial view and target; None for the search of `record_search`.
      config: the run's config, with `env.reachable` "path". With `env.motion` "kinematic" the arm follows the timed
        paths exactly, with "dynamic" as far as the arm's dynamics allow.

    Returns:
      Joint values at each frame; and for each step of the search the duration of its motion and the similarity of its
      image to the target's.

    Raises:
      PlanningError: a joint has no speed limit, so the duration of the motions is not known.
      SceneError: motion is dynamic, and a joint has no position actuator.
    """
    env = ViewSearchEnv(config, state.encoder, state.reach)
    actor = first_actor(state)
    start = start_episode(env, opposite_start(env, state.key) if key is None else _random_ends(env, key))

    def step(now: State) -> tuple[State, tuple[Array, Array]]:
        here = episode_of(now).observation.qpos
        view = env.commanded_view(now, sac.mean_action(actor, now, config))
        goal, is_solved = env.solve_joints(view, here)
        trajectory, motion = env.plan_motion(here, goal)
        motion = motion._replace(is_found=motion.is_found & is_solved)
        qpos, seconds = _sample_motion(env, trajectory, motion.is_found & (now.done < 0.5))
        return env.apply_transition(now, env.observe_view(view, qpos[-1]), motion), (qpos, seconds)

    states, (qpos, durations) = roll_out(step, start, config.env.episode_length)
    first, last = episode_of(start), jax.tree.map(lambda x: x[-1], states)
    return FilmedSearch(
        start_qpos=first.observation.qpos,
        target=first.target,
        qpos=qpos,
        durations=durations,
        similarity=states.metrics["similarity"],
        is_reachable=states.info["is_reachable"][1:] > 0.5,
        num_steps=episode_of(last).num_steps,
        is_found=last.done > 0.5,
    )


def _random_ends(env: ViewSearchEnv, key: Array) -> ViewRequest:
    """Returns the request for a random initial view and target, leading axis 2."""
    views, qpos = jax.vmap(env.random_view)(jax.random.split(key))
    return ViewRequest(views, qpos, jnp.zeros(2, bool))


def _sample_motion(env: ViewSearchEnv, trajectory: Trajectory, has_motion: Array) -> tuple[Array, Array]:
    """Returns joints f32[F, nq] at the frames of a motion and its duration f32[] s.

    The last joints are those at the end of the motion. Without a motion the first joints repeat and the duration is 0.
    """
    config, arm = env.config, env.arm
    number = jnp.arange(1, FPS * MAX_SECONDS + 1)
    # The last sample is the end of the motion, however long it takes: the search continues from there.
    times = jnp.where(number == number[-1], jnp.inf, number.astype(jnp.float32) / FPS)
    times = jnp.where(has_motion, times, 0.0)
    if config.env.motion == "dynamic":
        qpos, seconds = pass_through(arm, env.scene.mjx_model, trajectory, config.planning, times)
    else:
        qpos = jax.vmap(lambda time: state_at(arm, trajectory, time)[0])(times)
        seconds = duration(trajectory)
    qpos = jnp.where(has_motion, qpos, trajectory.waypoints[:1])
    return jnp.clip(qpos, arm.lower[None], arm.upper[None]), jnp.where(has_motion, seconds, 0.0)


@functools.partial(jax.jit, static_argnames=("config", "size"))
def render_frames(
    state: TrainState, qpos: Array, target: Observation, overview: Camera, config: Config, size: tuple[int, int]
) -> Frames:
    """Renders N frames of a film: the overview image and the wrist image for each of N joint vectors of the arm.

    Args:
      state: a trained state.
      qpos: f32[N, nq] rad or m, joint values of the arm at each frame.
      target: what the wrist camera sees from the target view.
      overview: camera in world that sees the whole arm.
      config: the run's config.
      size: height and width of the overview image in pixels.

    Returns:
      Images, and similarity to the target, of the N frames.
    """
    env = ViewSearchEnv(config, state.encoder, state.reach)
    surroundings = dataclasses.replace(env.render_scene, background=jnp.asarray(_SKY))

    def render_frame(qpos: Array) -> Frames:
        data, _ = env.forward(qpos)
        camera, image = env.wrist_image(qpos)
        code = encoders.code_of(env.encoder, env.raw_latent(image))
        offset = camera.position - env.center
        view = View(jnp.arctan2(offset[1], offset[0]), jnp.arctan2(offset[2], jnp.hypot(offset[0], offset[1])))
        scenery = render.supersample(surroundings, data, overview, size, _RAYS_PER_SIDE).rgb
        return Frames(_to_bytes(scenery), _to_bytes(image.rgb), cosine_similarity(code, target.code), view)

    return map_in_batches(render_frame, qpos, _BATCH_SIZE)


def _to_bytes(rgb: Array) -> Array:
    return jnp.round(255.0 * jnp.clip(rgb, 0.0, 1.0)).astype(jnp.uint8)
