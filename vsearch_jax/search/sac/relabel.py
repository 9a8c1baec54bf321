"""Goal relabelling (hindsight experience replay, Andrychowicz et al. 2017, arXiv 1707.01495)."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import Array

from vsearch_jax.config import EnvConfig, SACConfig
from vsearch_jax.env import step_reward
from vsearch_jax.geometry import cosine_similarity
from vsearch_jax.types import Transition


def relabel(
    key: Array, transitions: Transition, candidate_codes: Array, env_config: EnvConfig, config: SACConfig
) -> Transition:
    """Relabels replayed episode steps: replaces the target of some, then computes reward and `terminated` of all anew.

    A fraction `config.relabel_fraction` of the batch gets a new target. For two thirds of these, the target is a random
    one of `candidate_codes`. For one third, the target is the code after the transition's own step, so that the step is
    a success.

    A transition whose step was unreachable gets `unreachable_reward` and does not terminate, as in the environment. Its
    new target is always one of `candidate_codes`, because the step leads to no view.

    Args:
      key: PRNG key.
      transitions: a batch of episode steps; the batch axis leads. Each obs is code, target code and joint values in one
        vector.
      candidate_codes: f32[N, Z], image codes of N reachable views, Z numbers each.
      env_config: threshold and rewards.
      config: settings of soft actor-critic.

    Returns:
      The relabelled steps, in the same order.
    """
    num, size = transitions.reward.shape[0], candidate_codes.shape[-1]
    choice_key, candidate_key = jax.random.split(key)
    choice = jax.random.uniform(choice_key, (num,))
    candidate = candidate_codes[jax.random.randint(candidate_key, (num,), 0, candidate_codes.shape[0])]
    next_code = transitions.next_obs[:, :size]
    is_reachable = transitions.is_reachable > 0.5
    is_own = (choice < config.relabel_fraction / 3.0) & is_reachable
    is_new = choice < config.relabel_fraction
    target = transitions.obs[:, size : 2 * size]
    target = jnp.where(is_own[:, None], next_code, jnp.where(is_new[:, None], candidate, target))

    similarity = cosine_similarity(next_code, target)
    reward, is_found = step_reward(similarity, is_reachable, env_config)
    return transitions._replace(
        obs=_replace_target(transitions.obs, target),
        next_obs=_replace_target(transitions.next_obs, target),
        reward=reward,
        terminated=is_found.astype(transitions.terminated.dtype),
    )


def _replace_target(obs: Array, target: Array) -> Array:
    size = target.shape[-1]
    return jnp.concatenate([obs[:, :size], target, obs[:, 2 * size :]], axis=-1)
