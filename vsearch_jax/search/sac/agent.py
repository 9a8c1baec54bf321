"""Soft actor-critic with twin critics, in two forms; `SACConfig.algorithm` chooses.

`twin_q` has target critics and an automatic temperature (Haarnoja et al. 2018, arXiv 1812.05905). `value` has a state
value network with a target network, and a fixed temperature (Haarnoja et al. 2018, arXiv 1801.01290; thesis, algorithm
2). Three things differ from the papers: the critics have layer norm, the step size falls to zero over the run, and the
actor also learns known actions (`SACConfig.imitation_weight`). All were measured on this task. The falling step size
halves the policy's final error.
"""

from __future__ import annotations

from typing import NamedTuple, TypeVar, cast

import jax
import jax.numpy as jnp
import optax
from brax.training.distribution import NormalTanhDistribution
from flax import nnx
from jax import Array

from vsearch_jax.config import SACConfig
from vsearch_jax.search.sac.networks import Actor, Critic, Value, apply_network, init_network
from vsearch_jax.types import SACState, Transition

_ACTION_SIZE = 2

Params = TypeVar("Params", nnx.State, Array)


class KnownActions(NamedTuple):
    """Policy inputs for some of which the right action is known, because the target is within one step.

    Attributes:
      obs: f32[N, D], policy inputs.
      action: f32[N, 2] in [-1, 1], the action that leads to the target. Meaningless where it is not known.
      is_known: f32[N], 1 where the action is known, else 0.
    """

    obs: Array
    action: Array
    is_known: Array


def init(
    key: Array, config: SACConfig, observation_size: int, action_size: int = _ACTION_SIZE, code_size: int = 0
) -> SACState:
    """Creates the state of soft actor-critic before training: random networks and fresh optimizers.

    The target networks equal the networks.

    Args:
      key: PRNG key.
      config: settings of soft actor-critic.
      observation_size: number of entries in an obs, the policy's input vector.
      action_size: number of entries in an action.
      code_size: number of entries in a code, if the obs starts with two codes; else 0. Read with `network` "siamese".

    Returns:
      Parameters and optimizer states before the first update.
    """
    actor_key, critic_key = jax.random.split(key)
    code_size = code_size if config.network == "siamese" else 0
    value = None
    if config.algorithm == "value":
        sizes = (observation_size, *config.hidden_sizes, 1)
        value = init_network(jax.random.fold_in(critic_key, 2), Value, sizes, code_size)
    actor = init_network(actor_key, Actor, (observation_size, *config.hidden_sizes, 2 * action_size), code_size)
    sizes = (observation_size + action_size, *config.hidden_sizes, 1)
    critic = jax.vmap(lambda key: init_network(key, Critic, sizes, code_size))(jax.random.split(critic_key, 2))
    log_alpha = jnp.log(jnp.asarray(config.initial_temperature, jnp.float32))
    moved, third = (critic, log_alpha) if value is None else (value, value)
    optimizer = _optimizer(config)
    return SACState(
        actor=actor,
        critic=critic,
        target_critic=jax.tree.map(jnp.copy, moved),  # shared buffers would forbid the donation of the state
        log_alpha=log_alpha,
        value=value,
        opt_states=(optimizer.init(actor), optimizer.init(critic), optimizer.init(third)),
    )


def act(key: Array | None, actor: nnx.State, obs: Array, config: SACConfig, action_size: int = _ACTION_SIZE) -> Array:
    """Computes the policy's action, random or deterministic.

    Args:
      key: PRNG key of a random action. None gives the deterministic action: tanh of the mean.
      actor: parameters of the policy.
      obs: f32[..., D], input vectors of the policy, D numbers each.
      config: the settings with which `actor` was created.
      action_size: number of entries A in the action.

    Returns:
      Actions, f32[..., A] in [-1, 1].
    """
    distribution = NormalTanhDistribution(action_size)
    parameters = _action_parameters(actor, obs, config, action_size)
    if key is None:
        return distribution.mode(parameters)
    return distribution.sample(parameters, key)


def update(
    key: Array, state: SACState, transitions: Transition, config: SACConfig, known: KnownActions | None = None
) -> tuple[SACState, dict[str, Array]]:
    """Trains the policy by one gradient step of all networks, then updates the target networks.

    All gradients are computed at the parameters of `state`.

    Args:
      key: PRNG key.
      state: parameters and optimizer states before the step.
      transitions: a batch of episode steps, for example from the replay buffer; the batch axis leads.
      config: settings of soft actor-critic.
      known: actions that the actor's mean action must equal, besides maximising the critics' values.

    Returns:
      Parameters and optimizer states after the step, and metrics f32[]: `critic_loss`, `value_loss` (NaN for
      `twin_q`), `actor_loss` (with the part of `known`), `alpha` (the temperature before the step), `entropy` in nats.
    """
    target_key, actor_key = jax.random.split(key)
    target = td_target(target_key, state, transitions, config)
    critic_loss, critic_grads = jax.value_and_grad(_critic_loss)(state.critic, transitions, target, config)
    actor_grad = jax.value_and_grad(_actor_loss, has_aux=True)
    (actor_loss, entropy), actor_grads = actor_grad(state.actor, actor_key, state, transitions, config, known)

    actor, actor_opt = _apply_gradients(state.actor, actor_grads, state.opt_states[0], config)
    critic, critic_opt = _apply_gradients(state.critic, critic_grads, state.opt_states[1], config)
    log_alpha, value, source, value_loss = state.log_alpha, state.value, critic, jnp.full((), jnp.nan)
    if value is None:
        # Derivative of alpha (entropy - target entropy) with respect to log_alpha: arXiv 1812.05905, equation 18.
        alpha_grad = jnp.exp(log_alpha) * (entropy - config.target_entropy * transitions.action.shape[-1])
        log_alpha, third_opt = _apply_gradients(log_alpha, alpha_grad, state.opt_states[2], config)
    else:
        value_loss, value_grads = jax.value_and_grad(_value_loss)(value, actor_key, state, transitions, config)
        source, third_opt = _apply_gradients(value, value_grads, state.opt_states[2], config)
        value = source
    moved = optax.incremental_update(source, state.target_critic, config.tau)
    new_state = SACState(
        actor=actor,
        critic=critic,
        target_critic=cast(nnx.State, moved),  # optax returns the input's type, but declares any pytree
        log_alpha=log_alpha,
        value=value,
        opt_states=(actor_opt, critic_opt, third_opt),
    )
    alpha = jnp.exp(state.log_alpha)
    losses = {"critic_loss": critic_loss, "value_loss": value_loss, "actor_loss": actor_loss}
    return new_state, losses | {"alpha": alpha, "entropy": entropy}


def td_target(key: Array, state: SACState, transitions: Transition, config: SACConfig) -> Array:
    """Computes the values that the critics must learn: r + discount V(s').

    For `twin_q`, V(s') is min_i Q_i(s', a') - alpha log pi(a'|s') with the target critics Q_i and one random action a'.
    For `value`, V is the target value network. After a terminated step the future value is 0. After a truncated step
    the future value counts, because such a step has `terminated` = 0.

    Args:
      key: PRNG key of the next actions a'.
      state: parameters of target network and actor.
      transitions: a batch of B episode steps; the batch axis leads.
      config: settings of soft actor-critic; the discount is read.

    Returns:
      Target value of each step, f32[B].
    """
    obs = transitions.next_obs
    if state.value is None:
        action, log_prob = _sample_action(key, state.actor, obs, config, transitions.action.shape[-1])
        value = _twin_values(state.target_critic, obs, action, config).min(axis=0)
        soft_value = value - jnp.exp(state.log_alpha) * log_prob
    else:
        soft_value = _state_value(state.target_critic, obs, config)
    return transitions.reward + config.discount * (1.0 - transitions.terminated) * soft_value


def _critic_loss(critic: nnx.State, transitions: Transition, target: Array, config: SACConfig) -> Array:
    values = _twin_values(critic, transitions.obs, transitions.action, config)
    return 0.5 * jnp.sum(jnp.mean((values - target[None]) ** 2, axis=-1))


def _actor_loss(
    actor: nnx.State,
    key: Array,
    state: SACState,
    transitions: Transition,
    config: SACConfig,
    known: KnownActions | None,
) -> tuple[Array, Array]:
    """Returns the loss and the entropy in nats, both f32[]."""
    action, log_prob = _sample_action(key, actor, transitions.obs, config, transitions.action.shape[-1])
    value = _twin_values(state.critic, transitions.obs, action, config).min(axis=0)
    loss = jnp.mean(jnp.exp(state.log_alpha) * log_prob - value)
    if known is not None:
        loss = loss + config.imitation_weight * _imitation_loss(actor, known, config)
    return loss, -jnp.mean(log_prob)


def _imitation_loss(actor: nnx.State, known: KnownActions, config: SACConfig) -> Array:
    """Returns the mean squared distance f32[] of the mean actions from the known actions."""
    distance = jnp.sum((act(None, actor, known.obs, config) - known.action) ** 2, axis=-1)
    return jnp.sum(known.is_known * distance) / jnp.maximum(jnp.sum(known.is_known), 1.0)


def _value_loss(value: nnx.State, key: Array, state: SACState, transitions: Transition, config: SACConfig) -> Array:
    """Returns the loss of the state value network (arXiv 1801.01290, equation 5; thesis 4.22)."""
    action, log_prob = _sample_action(key, state.actor, transitions.obs, config, transitions.action.shape[-1])
    wanted = _twin_values(state.critic, transitions.obs, action, config).min(axis=0)
    wanted = jax.lax.stop_gradient(wanted - jnp.exp(state.log_alpha) * log_prob)
    return 0.5 * jnp.mean((_state_value(value, transitions.obs, config) - wanted) ** 2)


def _sample_action(
    key: Array, actor: nnx.State, obs: Array, config: SACConfig, action_size: int
) -> tuple[Array, Array]:
    """Returns random actions f32[..., action_size] and the logarithms of their densities f32[...]."""
    distribution = NormalTanhDistribution(action_size)
    parameters = _action_parameters(actor, obs, config, action_size)
    raw_action = distribution.sample_no_postprocessing(parameters, key)
    # brax computes the density from the action before tanh, because tanh saturates.
    return distribution.postprocess(raw_action), distribution.log_prob(parameters, raw_action)


def _action_parameters(actor: nnx.State, obs: Array, config: SACConfig, action_size: int) -> Array:
    """Returns f32[..., 2 * action_size], the parameters of the tanh-normal distribution of the action."""
    sizes = (obs.shape[-1], *config.hidden_sizes, 2 * action_size)
    return apply_network(Actor, sizes, actor, obs)


def _twin_values(critic: nnx.State, obs: Array, action: Array, config: SACConfig) -> Array:
    """Returns f32[2, ...], the values of both critics."""
    sizes = (obs.shape[-1] + action.shape[-1], *config.hidden_sizes, 1)
    return jax.vmap(lambda params: apply_network(Critic, sizes, params, obs, action))(critic)


def _state_value(value: nnx.State, obs: Array, config: SACConfig) -> Array:
    """Returns f32[...], the values of states."""
    return apply_network(Value, (obs.shape[-1], *config.hidden_sizes, 1), value, obs)


def _apply_gradients(
    params: Params, grads: Params, opt_state: optax.OptState, config: SACConfig
) -> tuple[Params, optax.OptState]:
    """Returns the parameters after one step of the optimizer, and the optimizer's state."""
    with jax.numpy_dtype_promotion("standard"):  # optax raises floats to the power of its integer count
        steps, opt_state = _optimizer(config).update(grads, opt_state)
    new_params = optax.apply_updates(params, steps)
    return cast(Params, new_params), opt_state  # optax returns the input's type, but declares any pytree


def _optimizer(config: SACConfig) -> optax.GradientTransformation:
    num_updates = (config.num_environment_steps - config.num_warmup_steps) * config.updates_per_step
    return optax.adam(optax.linear_schedule(config.learning_rate, 0.0, int(num_updates)))
