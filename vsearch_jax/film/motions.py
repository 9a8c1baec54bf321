"""One search of a policy as the arm does it, on a film's grid of times."""

from __future__ import annotations

import dataclasses
import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
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
"""Frames of a second."""
MOST_SECONDS = 60
"""Of one motion. What is longer is cut on the film, not in the search; `FilmedSearch.seconds` tells."""
_BATCH = 4
"""Frames that are drawn at a time: more take memory and are no faster."""
_SAMPLES = 3
"""Rays of a pixel of the overview, across and down."""
_SKY = (0.93, 0.94, 0.96)
"""Colour of the overview beyond the table."""


class FilmedSearch(NamedTuple):
    """A search as the arm does it; T = `episode_length`, F = `FPS` times `MOST_SECONDS`.

    Attributes:
      start: f32[nq] rad or m, joints at the initial view.
      target: Observation of the view that is looked for.
      joints: f32[T, F, nq] rad or m, in each motion at 1, 2, ... F frames since it began; where it ended from there on.
      seconds: f32[T], duration of each motion; 0 where the arm stayed.
      similarity: f32[T + 1], of the pictures taken, that of the initial view first.
      is_reachable: bool[T]; where not, the arm stayed.
      num_steps: i32[], steps done.
      is_found: bool[], the last of them met the threshold.
    """

    start: Array
    target: Observation
    joints: Array
    seconds: Array
    similarity: Array
    is_reachable: Array
    num_steps: Array
    is_found: Array


class Frames(NamedTuple):
    """What is seen at N moments of a search.

    Attributes:
      overview: u8[N, H, W, 3], of a camera beside the arm.
      wrist: u8[N, h, w, 3], of the wrist camera.
      similarity: f32[N], of the wrist camera's picture with the target's.
      view: View of f32[N] rad, where the wrist camera truly is.
    """

    overview: Array
    wrist: Array
    similarity: Array
    view: View


@functools.partial(jax.jit, static_argnames="config")
def film_search(state: TrainState, key: Array | None, config: Config) -> FilmedSearch:
    """Returns one search of the first policy, its motions on a grid of times.

    Args:
      state: a trained state.
      key: PRNG key of a random initial view and target; None for the search that `record_search` shows.
      config: the run's, with `env.reachable` "path"; by `env.motion` the arm is exactly on its timed paths or where its
        dynamics take it.

    Raises:
      PlanningError: the arm's model gives no speed limit for a joint, so that nothing says how long a motion takes.
      SceneError: motion is dynamic, and a joint has no position actuator.
    """
    env = ViewSearchEnv(config, state.encoder, state.reach)
    actor = first_actor(state)
    start = start_episode(env, opposite_start(env, state.key) if key is None else _random_ends(env, key))

    def step(now: Any) -> tuple[Any, tuple[Array, Array]]:
        here = episode_of(now).observation.qpos
        view = env.commanded_view(now, sac.act(None, actor, now.obs, config.sac))
        goal, is_solved = env.solve_joints(view, here)
        trajectory, motion = env.plan_motion(here, goal)
        motion = motion._replace(is_found=motion.is_found & is_solved)
        joints, seconds = _drive(env, trajectory, motion.is_found & (now.done < 0.5))
        return env.apply_transition(now, env.observe_view(view, joints[-1]), motion), (joints, seconds)

    states, (joints, seconds) = roll_out(step, start, config.env.episode_length)
    first, last = episode_of(start), jax.tree.map(lambda x: x[-1], states)
    return FilmedSearch(
        start=first.observation.qpos,
        target=first.target,
        joints=joints,
        seconds=seconds,
        similarity=states.metrics["similarity"],
        is_reachable=states.info["is_reachable"][1:] > 0.5,
        num_steps=episode_of(last).num_steps,
        is_found=last.done > 0.5,
    )


def _random_ends(env: ViewSearchEnv, key: Array) -> ViewRequest:
    views, joints = jax.vmap(env.random_view)(jax.random.split(key))
    return ViewRequest(views, joints, jnp.zeros(2, bool))


def _drive(env: ViewSearchEnv, trajectory: Trajectory, is_moved: Array) -> tuple[Array, Array]:
    """Returns joints f32[F, nq] on the film's grid, the last where the arm comes to stand, and the duration f32[] s."""
    config, arm = env.config, env.arm
    number = jnp.arange(1, FPS * MOST_SECONDS + 1)
    # The last is the end, however long it takes, since the search goes on from there.
    times = jnp.where(number == number[-1], jnp.inf, number.astype(jnp.float32) / FPS)
    times = jnp.where(is_moved, times, 0.0)
    if config.env.motion == "dynamic":
        joints, seconds = pass_through(arm, env.scene.mjx_model, trajectory, config.planning, times)
    else:
        joints = jax.vmap(lambda time: state_at(arm, trajectory, time)[0])(times)
        seconds = duration(trajectory)
    joints = jnp.where(is_moved, joints, trajectory.waypoints[:1])
    return jnp.clip(joints, arm.lower[None], arm.upper[None]), jnp.where(is_moved, seconds, 0.0)


@functools.partial(jax.jit, static_argnames=("config", "size"))
def look_along(
    state: TrainState, qpos: Array, target: Observation, overview: Camera, config: Config, size: tuple[int, int]
) -> Frames:
    """Returns what is seen with the arm at each of `qpos`.

    Args:
      state: a trained state.
      qpos: f32[N, nq] rad or m.
      target: Observation of the view that is looked for.
      overview: Camera beside the arm.
      config: the run's.
      size: height and width in pixels of the overview.
    """
    env = ViewSearchEnv(config, state.encoder, state.reach)
    surroundings = dataclasses.replace(env.render_scene, background=jnp.asarray(_SKY))

    def look(joints: Array) -> Frames:
        data, _ = env.forward(joints)
        camera, image = env.wrist_image(joints)
        code = encoders.code_of(env.encoder, env.raw_latent(image))
        away = camera.position - env.center
        view = View(jnp.arctan2(away[1], away[0]), jnp.arctan2(away[2], jnp.hypot(away[0], away[1])))
        scenery = render.supersample(surroundings, data, overview, size, _SAMPLES).rgb
        return Frames(_bytes(scenery), _bytes(image.rgb), cosine_similarity(code, target.code), view)

    return map_in_batches(look, qpos, _BATCH)


def _bytes(rgb: Array) -> Array:
    return jnp.round(255.0 * jnp.clip(rgb, 0.0, 1.0)).astype(jnp.uint8)
