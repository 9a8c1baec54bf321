"""One search of a policy in pictures."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from vsearch_jax.config import Config
from vsearch_jax.env import ViewSearchEnv
from vsearch_jax.evaluation.views import ViewRequest, observe_request, protocol_target
from vsearch_jax.geometry import wrap_angle
from vsearch_jax.search import sac
from vsearch_jax.types import TrainState, View
from vsearch_jax.xla.tree import tree_where


@functools.partial(jax.jit, static_argnames="config")
def record_search(state: TrainState, config: Config) -> dict[str, Array]:
    """Returns one search of the first policy in pictures: from the far side of the object to the protocol's target.

    Returns:
      `images` f32[T + 1, H, W, 3], start first, T = `episode_length`; `similarity` f32[T + 1]; `target` f32[H, W, 3];
      `num_steps` i32[], after which the rest repeats.
    """
    env = ViewSearchEnv(config, state.encoder, state.reach)
    actor = first_actor(state)
    start = start_episode(env, opposite_start(env, state.key))

    def step(now: Any) -> tuple[Any, None]:
        return env.step(now, sac.act(None, actor, now.obs, config.sac)), None

    states, _ = roll_out(step, start, config.env.episode_length)
    return {
        "images": jax.lax.map(lambda qpos: env.wrist_image(qpos)[1].rgb, states.pipeline_state.observation.qpos),
        "similarity": states.metrics["similarity"],
        "target": env.wrist_image(start.pipeline_state.target.qpos)[1].rgb,
        "num_steps": states.pipeline_state.num_steps[-1],
    }


def first_actor(state: TrainState) -> Any:
    """Returns the parameters of the first of the run's policies."""
    return jax.tree.map(lambda x: x[0], state.sac.actor)


def opposite_start(env: ViewSearchEnv, key: Array) -> ViewRequest:
    """Returns, leading axis 2, an initial view beyond the object and the protocol's target.

    Args:
      env: the task.
      key: that of the TrainState.
    """
    target = protocol_target(env.config)
    initial = View(wrap_angle(target.azimuth + math.radians(165.0)), jnp.mean(env.reach.band))
    views = jax.tree.map(lambda *x: jnp.stack(x), initial, target)
    keys = jax.random.split(jax.random.fold_in(key, 2**31 - 2))
    return ViewRequest(views, jax.vmap(env.random_joints)(keys), jnp.ones(2, bool))


def start_episode(env: ViewSearchEnv, ends: ViewRequest) -> Any:
    """Returns the brax State at the start of the episode between `ends`, initial view and target on a leading axis."""
    observations = jax.lax.map(functools.partial(observe_request, env), ends)
    return env.start(*(jax.tree.map(lambda x, i=i: x[i], observations) for i in range(2)))


def roll_out(step: Callable[[Any], tuple[Any, Any]], start: Any, length: int) -> tuple[Any, Any]:
    """Follows an episode to its end.

    Args:
      step: brax State -> the next one, and whatever is to be kept of the step.
      start: brax State.
      length: T, the most steps.

    Returns:
      States, leading axis T + 1, the start first, and what was kept, leading axis T. After the end the state repeats.
    """

    def go_on(state: Any, _: None) -> tuple[Any, Any]:
        moved, kept = step(state)
        moved = tree_where(state.done > 0, state, moved)
        return moved, (moved, kept)

    _, (states, kept) = jax.lax.scan(go_on, start, length=length)
    return jax.tree.map(lambda first, rest: jnp.concatenate([first[None], rest]), start, states), kept
