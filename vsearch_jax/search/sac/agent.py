"""Soft actor-critic with twin critics and an automatic temperature (Haarnoja et al. 2018, arXiv 1812.05905).

Two things differ from the paper, both measured on this task: layer norm in the critics, and a step size that falls to
zero over the run, which halves the policy's final error.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import optax
from brax.training.distribution import NormalTanhDistribution
from jax import Array

from vsearch_jax.config import SACConfig
from vsearch_jax.search.sac.networks import Actor, Critic, apply_network, init_network
from vsearch_jax.types import SACState, Transition

_ACTION_SIZE = 2


def init(key: Array, config: SACConfig, observation_size: int, action_size: int = _ACTION_SIZE) -> SACState:
    """Returns a fresh SACState: random actor and critics, the target critics equal to the critics.

    Args:
      key: PRNG key.
      config: SACConfig.
      observation_size: entries of an observation.
      action_size: entries of an action.
    """
    actor_key, critic_key = jax.random.split(key)
    actor = init_network(actor_key, Actor, (observation_size, *config.hidden_sizes, 2 * action_size))
    sizes = (observation_size + action_size, *config.hidden_sizes, 1)
    critic = jax.vmap(lambda key: init_network(key, Critic, sizes))(jax.random.split(critic_key, 2))
    log_alpha = jnp.log(jnp.asarray(config.initial_temperature, jnp.float32))
    optimizer = _optimizer(config)
    return SACState(
        actor=actor,
        critic=critic,
        target_critic=jax.tree.map(jnp.copy, critic),  # buffers of its own, so that the state can be donated
        log_alpha=log_alpha,
        opt_states=(optimizer.init(actor), optimizer.init(critic), optimizer.init(log_alpha)),
    )


def act(key: Array | None, actor: Any, observation: Array, config: SACConfig, action_size: int = _ACTION_SIZE) -> Array:
    """Returns an action, f32[..., action_size] in [-1, 1].

    Args:
      key: PRNG key of a random action; None for the mean of the policy before tanh, the deterministic policy.
      actor: parameters of the policy.
      observation: f32[..., observation_size].
      config: SACConfig that `actor` was made with.
      action_size: entries of the action.
    """
    distribution = NormalTanhDistribution(action_size)
    parameters = _policy(actor, observation, config, action_size)
    if key is None:
        return distribution.mode(parameters)
    return distribution.sample(parameters, key)


def update(
    key: Array, state: SACState, transitions: Transition, config: SACConfig
) -> tuple[SACState, dict[str, Array]]:
    """Does one gradient step of critics, actor and temperature, and moves the target critics.

    All three gradients are taken at the parameters of `state`.

    Args:
      key: PRNG key.
      state: SACState.
      transitions: Transition with a leading batch axis.
      config: SACConfig.

    Returns:
      The new state, and metrics f32[]: `critic_loss`, `actor_loss`, `alpha` (the temperature), `entropy` in nats.
    """
    target_key, actor_key = jax.random.split(key)
    target = td_target(target_key, state, transitions, config)
    critic_loss, critic_grads = jax.value_and_grad(_critic_loss)(state.critic, transitions, target, config)
    actor_grad = jax.value_and_grad(_actor_loss, has_aux=True)
    (actor_loss, entropy), actor_grads = actor_grad(state.actor, actor_key, state, transitions, config)
    alpha = jnp.exp(state.log_alpha)
    # Gradient by log_alpha of alpha (entropy - target entropy): arXiv 1812.05905, equation 18.
    alpha_grad = alpha * (entropy - config.target_entropy * transitions.action.shape[-1])

    actor, actor_opt = _descend(state.actor, actor_grads, state.opt_states[0], config)
    critic, critic_opt = _descend(state.critic, critic_grads, state.opt_states[1], config)
    log_alpha, alpha_opt = _descend(state.log_alpha, alpha_grad, state.opt_states[2], config)
    new_state = SACState(
        actor=actor,
        critic=critic,
        target_critic=optax.incremental_update(critic, state.target_critic, config.tau),
        log_alpha=log_alpha,
        opt_states=(actor_opt, critic_opt, alpha_opt),
    )
    metrics = {"critic_loss": critic_loss, "actor_loss": actor_loss, "alpha": alpha, "entropy": entropy}
    return new_state, metrics


def td_target(key: Array, state: SACState, transitions: Transition, config: SACConfig) -> Array:
    """Returns f32[B], the values that the critics should learn: r + discount (min_i Q_i(s', a') - alpha log pi(a'|s')).

    After a termination nothing follows; after a truncation the value goes on.

    Args:
      key: PRNG key of the next actions a'.
      state: SACState; the target critics give the values.
      transitions: Transition with a leading batch axis B.
      config: SACConfig.
    """
    observation = transitions.next_obs
    action, log_prob = _sample(key, state.actor, observation, config, transitions.action.shape[-1])
    value = _values(state.target_critic, observation, action, config).min(axis=0)
    soft_value = value - jnp.exp(state.log_alpha) * log_prob
    return transitions.reward + config.discount * (1.0 - transitions.terminated) * soft_value


def _critic_loss(critic: Any, transitions: Transition, target: Array, config: SACConfig) -> Array:
    values = _values(critic, transitions.obs, transitions.action, config)
    return 0.5 * jnp.sum(jnp.mean((values - target[None]) ** 2, axis=-1))


def _actor_loss(
    actor: Any, key: Array, state: SACState, transitions: Transition, config: SACConfig
) -> tuple[Array, Array]:
    """Returns the loss and the entropy, both f32[]."""
    action, log_prob = _sample(key, actor, transitions.obs, config, transitions.action.shape[-1])
    value = _values(state.critic, transitions.obs, action, config).min(axis=0)
    return jnp.mean(jnp.exp(state.log_alpha) * log_prob - value), -jnp.mean(log_prob)


def _sample(key: Array, actor: Any, observation: Array, config: SACConfig, action_size: int) -> tuple[Array, Array]:
    """Returns random actions f32[..., action_size] and the logarithms of their densities f32[...]."""
    distribution = NormalTanhDistribution(action_size)
    parameters = _policy(actor, observation, config, action_size)
    raw_action = distribution.sample_no_postprocessing(parameters, key)
    # brax takes the density at the action before tanh, since tanh saturates
    return distribution.postprocess(raw_action), distribution.log_prob(parameters, raw_action)


def _policy(actor: Any, observation: Array, config: SACConfig, action_size: int) -> Array:
    sizes = (observation.shape[-1], *config.hidden_sizes, 2 * action_size)
    return apply_network(Actor, sizes, actor, observation)


def _values(critic: Any, observation: Array, action: Array, config: SACConfig) -> Array:
    """Returns f32[2, ...], the values by both critics."""
    sizes = (observation.shape[-1] + action.shape[-1], *config.hidden_sizes, 1)
    return jax.vmap(lambda params: apply_network(Critic, sizes, params, observation, action))(critic)


def _descend(params: Any, grads: Any, opt_state: Any, config: SACConfig) -> tuple[Any, Any]:
    """Returns the parameters after one step of the optimizer, and its state."""
    with jax.numpy_dtype_promotion("standard"):  # optax raises floats to the power of its integer count
        steps, opt_state = _optimizer(config).update(grads, opt_state)
    return optax.apply_updates(params, steps), opt_state


def _optimizer(config: SACConfig) -> optax.GradientTransformation:
    num_updates = (config.num_environment_steps - config.num_warmup_steps) * config.updates_per_step
    return optax.adam(optax.linear_schedule(config.learning_rate, 0.0, int(num_updates)))
