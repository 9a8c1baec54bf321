"""Records one search of a policy as images."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from typing import TYPE_CHECKING, TypeVar

import jax
import jax.numpy as jnp
from brax.envs.base import State
from jax import Array

from vsearch_jax.config import Config
from vsearch_jax.env import ViewSearchEnv, episode_of, protocol_target
from vsearch_jax.evaluation.views import ViewRequest, observe_request
from vsearch_jax.geometry import wrap_angle
from vsearch_jax.search import sac
from vsearch_jax.types import TrainState, View
from vsearch_jax.xla.tree import tree_where

if TYPE_CHECKING:
    from flax import nnx

StepOutput = TypeVar("StepOutput")


@functools.partial(jax.jit, static_argnames="config")
def record_search(state: TrainState, config: Config) -> dict[str, Array]:
    """Records the images of one search by the run's first policy.

    The search starts behind the object and looks for the target view of the evaluation.

    Args:
      state: a trained state.
      config: the run's config.

    Returns:
      `images` f32[T + 1, H, W, 3] of the wrist camera, H x W pixels each, the initial view first; T is the config's
      `episode_length`. `similarity` f32[T + 1], cosine of each image's code and the target's code. `target`
      f32[H, W, 3], the target image. `num_steps` i32[], steps until the end of the search. After `num_steps` steps the
      last image and similarity repeat.
    """
    env = ViewSearchEnv(config, state.encoder, state.reach)
    actor = first_actor(state)
    start = start_episode(env, opposite_start(env, state.key))

    def step(now: State) -> tuple[State, None]:
        return env.step(now, sac.mean_action(actor, now, config)), None

    def render_wrist(qpos: Array) -> Array:
        return env.wrist_image(qpos)[1].rgb

    states, _ = roll_out(step, start, config.env.episode_length)
    episodes = episode_of(states)
    qpos = jnp.concatenate([episode_of(start).target.qpos[None], episodes.observation.qpos])
    images = jax.lax.map(render_wrist, qpos)  # one call, because XLA compiles the renderer anew for each
    return {
        "images": images[1:],
        "similarity": states.metrics["similarity"],
        "target": images[0],
        "num_steps": episodes.num_steps[-1],
    }


def first_actor(state: TrainState) -> nnx.State:
    """Returns the parameters of the run's first policy. A run trains one policy for each policy seed."""
    return jax.tree.map(lambda x: x[0], state.sac.actor)


def opposite_start(env: ViewSearchEnv, key: Array) -> ViewRequest:
    """Chooses the initial view and the target view of a recorded search.

    The target is that of the evaluation. The initial view lies on the opposite side of the object, 165 degrees of
    azimuth away, in the middle of the reachable elevations.

    Args:
      env: the task.
      key: PRNG key of the run (`TrainState.key`). IK starts from random joint values drawn from it.

    Returns:
      Two ViewRequests (leading axis 2), the initial view first. The nearest reachable view of the map replaces a view
      that the arm cannot reach.
    """
    target = protocol_target(env.config)
    initial = View(wrap_angle(target.azimuth + math.radians(165.0)), jnp.mean(env.reach.band))
    views = jax.tree.map(lambda *x: jnp.stack(x), initial, target)
    keys = jax.random.split(jax.random.fold_in(key, 2**31 - 2))  # a salt that training does not use
    return ViewRequest(views, jax.vmap(env.random_joints)(keys), jnp.zeros(2, bool))


def start_episode(env: ViewSearchEnv, ends: ViewRequest) -> State:
    """Starts an episode from requested views: takes the images of initial view and target view.

    Args:
      env: the task.
      ends: the requested views, leading axis 2: initial view, target view. A reachable view may replace each of them.

    Returns:
      brax State at the start of the episode.
    """
    observations = jax.lax.map(functools.partial(observe_request, env), ends).observation
    return env.start(*(jax.tree.map(lambda x, i=i: x[i], observations) for i in range(2)))


def roll_out(step: Callable[[State], tuple[State, StepOutput]], start: State, length: int) -> tuple[State, StepOutput]:
    """Runs one episode for T steps, and returns all states. After the end of the episode the last state repeats.

    Args:
      step: function from the brax State to the next State and to any pytree that is to be kept of the step.
      start: brax State at the start of the episode.
      length: number of steps T.

    Returns:
      States, leading axis T + 1, `start` first; and the pytrees of the steps, leading axis T.
    """

    def step_until_done(state: State, _: None) -> tuple[State, tuple[State, StepOutput]]:
        next_state, output = step(state)
        next_state = tree_where(state.done > 0, state, next_state)
        return next_state, (next_state, output)

    _, (states, outputs) = jax.lax.scan(step_until_done, start, length=length)
    return jax.tree.map(lambda first, rest: jnp.concatenate([first[None], rest]), start, states), outputs
