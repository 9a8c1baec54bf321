"""One search of a policy in pictures."""

from __future__ import annotations

import functools
import math
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from vsearch_jax.config import Config
from vsearch_jax.env import ViewSearchEnv
from vsearch_jax.evaluation.views import Asked, look_at, protocol_target
from vsearch_jax.geometry import wrap_angle
from vsearch_jax.search import sac
from vsearch_jax.types import TrainState, View


@functools.partial(jax.jit, static_argnames="config")
def record_search(state: TrainState, config: Config) -> dict[str, Array]:
    """Returns one search of the first policy in pictures: from the far side of the object to the protocol's target.

    Returns:
      `images` f32[T + 1, H, W, 3], start first, T = `episode_length`; `similarity` f32[T + 1]; `target` f32[H, W, 3];
      `num_steps` i32[], after which the rest repeats.
    """
    env = ViewSearchEnv(config, state.encoder, state.reach)
    actor = jax.tree.map(lambda x: x[0], state.sac.actor)
    initial_key, target_key = jax.random.split(jax.random.fold_in(state.key, 2**31 - 2))
    target_view = protocol_target(config)
    far_side = View(wrap_angle(target_view.azimuth + math.radians(165.0)), jnp.mean(env.reach.band))
    keys, is_fixed = (initial_key, target_key), jnp.bool_(True)
    asked = (Asked(view, env.random_joints(k), is_fixed) for k, view in zip(keys, (far_side, target_view), strict=True))
    initial, target = (look_at(env, one) for one in asked)
    start = env.start(initial, target)

    def step(state: Any, _: None) -> tuple[Any, Any]:
        moved = env.step(state, sac.act(None, actor, state.obs, config.sac))
        moved = jax.tree.map(lambda new, old: jnp.where(state.done > 0, old, new), moved, state)
        return moved, moved

    _, states = jax.lax.scan(step, start, length=config.env.episode_length)
    states = jax.tree.map(lambda first, rest: jnp.concatenate([first[None], rest]), start, states)
    return {
        "images": jax.lax.map(lambda qpos: env.picture(qpos)[1].rgb, states.pipeline_state.sight.qpos),
        "similarity": states.metrics["similarity"],
        "target": env.picture(target.qpos)[1].rgb,
        "num_steps": states.pipeline_state.num_steps[-1],
    }
