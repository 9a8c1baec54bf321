"""Target values, gradient step and actions of soft actor-critic, compared with values computed by hand."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import probes
from vsearch_jax.config import EnvConfig, SACConfig
from vsearch_jax.env import episode_of
from vsearch_jax.search import sac
from vsearch_jax.training import transition_of
from vsearch_jax.types import SACState, Transition

SMALL = SACConfig(hidden_sizes=(8, 8), batch_size=4, discount=0.9)

update = jax.jit(sac.update, static_argnames="config")
td_target = jax.jit(sac.td_target, static_argnames="config")
init = jax.jit(sac.init, static_argnames=("config", "observation_size"))


def transitions(reward, terminated, size=6) -> Transition:
    num = len(reward)
    obs = jax.random.normal(jax.random.key(11), (2, num, size))
    return Transition(
        obs=obs[0],
        action=jnp.full((num, 2), 0.5),
        reward=jnp.asarray(reward, jnp.float32),
        next_obs=obs[1],
        terminated=jnp.asarray(terminated, jnp.float32),
        is_reachable=jnp.ones(num),
    )


def with_constant_values(state: SACState, values: tuple[float, float]) -> SACState:
    """Returns the state with target critics whose values are `values` everywhere."""
    target_critic = jax.tree.map(jnp.zeros_like, state.target_critic)
    last = len(SMALL.hidden_sizes)
    target_critic["layers"][last]["bias"] = target_critic["layers"][last]["bias"].replace(jnp.asarray(values)[:, None])
    return dataclasses.replace(state, target_critic=target_critic)


def without_entropy(state: SACState) -> SACState:
    return dataclasses.replace(state, log_alpha=jnp.asarray(-jnp.inf))


def test_the_target_uses_the_smaller_critic_and_has_no_future_value_after_termination():
    state = without_entropy(with_constant_values(init(jax.random.key(0), SMALL, 6), (5.0, 3.0)))
    target = td_target(jax.random.key(1), state, transitions([1.0, 1.0, 1.0], terminated=[0, 1, 0]), SMALL)
    np.testing.assert_allclose(target, [1.0 + 0.9 * 3.0, 1.0, 1.0 + 0.9 * 3.0], rtol=1e-6)


def test_the_target_keeps_the_future_value_of_a_step_that_the_environment_truncates():
    env = probes.SphereEnv(EnvConfig())
    start = env.reset(jax.random.key(0))
    last = dataclasses.replace(episode_of(start), num_steps=jnp.int32(env.config.episode_length - 1))
    before = dataclasses.replace(start, pipeline_state=probes.as_pipeline_state(last))
    action = jnp.zeros(2)
    after = env.step(before, action)
    assert (float(after.info["truncated"]), float(after.info["terminated"])) == (1.0, 0.0)
    batch = jax.tree.map(lambda x: x[None], transition_of(before, action, after))
    state = init(jax.random.key(0), SMALL, env.observation_size)
    state = without_entropy(with_constant_values(state, (5.0, 3.0)))
    target = td_target(jax.random.key(1), state, batch, SMALL)
    np.testing.assert_allclose(target, after.reward[None] + 0.9 * 3.0, rtol=1e-6)


def test_the_target_includes_the_entropy_of_the_next_action():
    """The mean target is min Q + alpha H. The entropy H comes from numerical integration of the density."""
    state = with_constant_values(init(jax.random.key(0), SMALL, 6), (0.0, 0.0))
    actor = jax.tree.map(jnp.zeros_like, state.actor)  # before tanh: mean 0, standard deviation softplus(0) + 0.001
    state = dataclasses.replace(state, actor=actor, log_alpha=jnp.zeros(()))
    num = 20_000
    batch = transitions([0.0] * num, [0] * num)
    target = td_target(jax.random.key(1), state, batch, dataclasses.replace(SMALL, discount=1.0))
    raw = np.linspace(-8.0, 8.0, 20_001)
    std = np.log(2.0) + 0.001
    density = np.exp(-0.5 * (raw / std) ** 2) / (std * np.sqrt(2.0 * np.pi))
    log_density = np.log(density) - np.log(1.0 - np.tanh(raw) ** 2)
    entropy = 2.0 * -np.sum(density * log_density) * (raw[1] - raw[0])
    assert float(target.mean()) == pytest.approx(entropy, abs=0.03)


def test_an_update_changes_the_target_critics_by_tau_and_the_temperature_towards_the_target_entropy():
    state = init(jax.random.key(0), SMALL, 6)
    batch = transitions([1.0, 0.0, -1.0, 0.5], [0, 1, 0, 0])
    config = dataclasses.replace(SMALL, tau=0.25)
    new, metrics = update(jax.random.key(1), state, batch, config)
    expected = jax.tree.map(lambda old, now: 0.75 * old + 0.25 * now, state.target_critic, new.critic)
    jax.tree.map(functools.partial(np.testing.assert_allclose, atol=1e-6), new.target_critic, expected)
    assert float(new.log_alpha) < float(state.log_alpha)  # the entropy of a new policy is above -2 nats an entry
    high_entropy = dataclasses.replace(config, target_entropy=0.69)
    assert float(update(jax.random.key(1), state, batch, high_entropy)[0].log_alpha) > float(state.log_alpha)
    assert np.isnan(metrics.pop("value_loss"))
    assert all(np.isfinite(value) for value in metrics.values())


def test_the_mean_action_comes_to_equal_the_known_actions_and_only_these():
    config = dataclasses.replace(SMALL, imitation_weight=100.0, num_warmup_steps=16, learning_rate=1e-2)
    state, batch = init(jax.random.key(0), config, 6), transitions([1.0, 0.0, -1.0, 0.5], [0, 1, 0, 0])
    wanted = jnp.asarray([[0.4, -0.7], [-0.2, 0.1], [5.0, 5.0], [-5.0, 5.0]])
    known = sac.KnownActions(batch.next_obs, wanted, jnp.asarray([1.0, 1.0, 0.0, 0.0]))

    def step(i, state):
        return sac.update(jax.random.fold_in(jax.random.key(1), i), state, batch, config, known)[0]

    state = jax.jit(functools.partial(jax.lax.fori_loop, 0, 300, step))(state)
    action = sac.act(None, state.actor, batch.next_obs, config)
    np.testing.assert_allclose(action[:2], wanted[:2], atol=0.03)
    unknown = known._replace(is_known=jnp.zeros(4))
    with_none, with_unknown = (update(jax.random.key(1), state, batch, config, k)[0].actor for k in (None, unknown))
    # Two programs, so the order of sums may differ.
    jax.tree.map(functools.partial(np.testing.assert_allclose, rtol=1e-5, atol=1e-6), with_none, with_unknown)


def test_with_a_value_network_its_copy_changes_by_tau_and_the_temperature_stays():
    config = dataclasses.replace(SMALL, algorithm="value", tau=0.25)
    state = init(jax.random.key(0), config, 6)
    new, metrics = update(jax.random.key(1), state, transitions([1.0, 0.0, -1.0, 0.5], [0, 1, 0, 0]), config)
    expected = jax.tree.map(lambda old, now: 0.75 * old + 0.25 * now, state.target_critic, new.value)
    jax.tree.map(functools.partial(np.testing.assert_allclose, atol=1e-6), new.target_critic, expected)
    changes = jax.tree.map(lambda a, b: np.abs(np.asarray(a) - np.asarray(b)).max(), new.value, state.value)
    assert max(jax.tree.leaves(changes)) > 0.0
    assert float(new.log_alpha) == float(state.log_alpha)
    assert all(np.isfinite(value) for value in metrics.values())


def test_the_step_size_falls_to_zero_over_the_run():
    config = dataclasses.replace(SMALL, num_environment_steps=80, num_warmup_steps=16, updates_per_step=0.25)
    state = init(jax.random.key(0), config, 6)
    batch = transitions([1.0, 0.0, -1.0, 0.5], [0, 1, 0, 0])
    steps = []
    for i in range(17):  # the run has 16 updates
        new, _ = update(jax.random.key(i), state, batch, config)
        changes = jax.tree.map(lambda a, b: np.abs(np.asarray(a) - np.asarray(b)).max(), new.actor, state.actor)
        steps.append(max(jax.tree.leaves(changes)))
        state = new
    assert steps[16] == 0.0
    assert 0.0 < steps[15] < 0.3 * steps[0]


def test_the_mean_action_is_deterministic_and_random_actions_differ():
    state = init(jax.random.key(0), SMALL, 6)
    obs = jnp.ones((3, 6))
    mean, mean_again = (sac.act(None, state.actor, obs, SMALL) for _ in range(2))
    first, second = (sac.act(jax.random.key(i), state.actor, obs, SMALL) for i in range(2))
    assert mean.shape == (3, 2)
    np.testing.assert_array_equal(mean, mean_again)
    assert np.abs(first).max() <= 1.0
    assert not np.allclose(first, second)
