"""Training with soft actor-critic on problems with a known answer."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import probes
from vsearch_jax.config import Config, EnvConfig, SACConfig
from vsearch_jax.env import episode_of
from vsearch_jax.search import SearchArgs, sac
from vsearch_jax.training import transition_of
from vsearch_jax.types import SACState, Transition
from vsearch_jax.xla.tree import tree_where

ENV = EnvConfig()
BANDIT = SACConfig(
    hidden_sizes=(32, 32), num_environment_steps=2512, initial_temperature=0.01, learning_rate=3e-3, target_entropy=-3.0
)
SPHERE = SACConfig(
    hidden_sizes=(64, 64),
    batch_size=64,
    num_environment_steps=6144,
    num_warmup_steps=512,
    updates_per_step=2.0,
    learning_rate=2e-3,
)


def train_on_batches(config: SACConfig, make_batch, num_updates: int, observation_size: int) -> SACState:
    """Returns the state after `num_updates` updates, each with a batch from `make_batch(key)`."""

    def update_once(i, state):
        sample_key, update_key = jax.random.split(jax.random.fold_in(jax.random.key(5), i))
        return sac.update(update_key, state, make_batch(sample_key), config)[0]

    state = sac.init(jax.random.key(4), config, observation_size)
    return jax.jit(lambda state: jax.lax.fori_loop(0, num_updates, update_once, state))(state)


def bandit_batch(key, terminated=1.0) -> Transition:
    """Returns a batch with the reward -|action - obs|^2, so that the best action equals the obs."""
    obs_key, action_key = jax.random.split(key)
    obs = jax.random.uniform(obs_key, (64, 2), minval=-0.7, maxval=0.7)
    action = jax.random.uniform(action_key, (64, 2), minval=-1.0, maxval=1.0)
    reward = -jnp.sum((action - obs) ** 2, axis=-1)
    return Transition(obs, action, reward, obs, jnp.full((64,), terminated), jnp.ones(64))


@pytest.mark.parametrize("algorithm", ["twin_q", "value"])
def test_a_bandit_with_continuous_contexts_is_solved(algorithm):
    config = dataclasses.replace(BANDIT, algorithm=algorithm)
    state = train_on_batches(config, bandit_batch, 2000, 2)
    obs = jax.random.uniform(jax.random.key(9), (100, 2), minval=-0.7, maxval=0.7)
    action = sac.act(None, state.actor, obs, config)
    assert float(jnp.abs(action - obs).mean()) < 0.1  # an untrained policy has 0.6


@pytest.mark.parametrize("algorithm", ["twin_q", "value"])
def test_values_include_the_future_unless_a_step_terminates(algorithm):
    """With reward 1 in each step, the value is 1 / (1 - discount). If every step terminates, the value is 1."""
    config = dataclasses.replace(BANDIT, algorithm=algorithm, discount=0.5, tau=0.1, initial_temperature=1e-6)

    def batch_of(key, terminated):
        return bandit_batch(key, terminated)._replace(reward=jnp.ones(64))

    for terminated, value in ((0.0, 2.0), (1.0, 1.0)):
        state = train_on_batches(config, functools.partial(batch_of, terminated=terminated), 500, 2)
        batch = batch_of(jax.random.key(3), 0.0)._replace(reward=jnp.zeros(64))
        target = jax.jit(sac.td_target, static_argnames="config")(jax.random.key(0), state, batch, config)
        np.testing.assert_allclose(target, 0.5 * value, atol=0.1)


def run_iteration(env, carry, key, *, is_warm):
    """Steps all environments once. If the warm-up is over, it also updates the networks."""
    sac_state, states, replay = carry
    act_key, restart_key, update_key = jax.random.split(key, 3)
    actions = sac.act(act_key, sac_state.actor, states.obs, SPHERE)
    if not is_warm:
        actions = jax.random.uniform(act_key, actions.shape, minval=-1.0, maxval=1.0)
    next_states = jax.vmap(env.step)(states, actions)
    replay = sac.insert(replay, transition_of(states, actions, next_states))
    is_ended = next_states.info["terminated"] + next_states.info["truncated"] > 0
    restarted = jax.vmap(env.reset)(jax.random.split(restart_key, SPHERE.num_envs))
    states = jax.vmap(tree_where)(is_ended, restarted, next_states)

    def update_once(i, sac_state):
        sample_key, relabel_key, key = jax.random.split(jax.random.fold_in(update_key, i), 3)
        batch = sac.sample_batch(sample_key, replay, SPHERE.batch_size)
        codes = batch.next_obs[:, :48]
        return sac.update(key, sac_state, sac.relabel(relabel_key, batch, codes, ENV, SPHERE), SPHERE)[0]

    if is_warm:
        num_updates = int(SPHERE.num_envs * SPHERE.updates_per_step)
        sac_state = jax.lax.fori_loop(0, num_updates, update_once, sac_state)
    return (sac_state, states, replay), None


@pytest.fixture(scope="module")
def actor():
    """Returns the parameters of a policy trained on SphereEnv."""
    env = probes.SphereEnv(ENV)
    states = jax.vmap(env.reset)(jax.random.split(jax.random.key(0), SPHERE.num_envs))
    sac_state = sac.init(jax.random.key(1), SPHERE, env.observation_size)
    example = transition_of(states, jnp.zeros((SPHERE.num_envs, 2)), states)
    replay = sac.init_replay(jax.tree.map(lambda x: x[0], example), SPHERE.num_environment_steps)
    carry = (sac_state, states, replay)
    num_warmup = SPHERE.num_warmup_steps // SPHERE.num_envs
    keys = jax.random.split(jax.random.key(2), SPHERE.num_environment_steps // SPHERE.num_envs)
    for is_warm, part in ((False, keys[:num_warmup]), (True, keys[num_warmup:])):
        body = functools.partial(run_iteration, env, is_warm=is_warm)
        carry = jax.jit(lambda carry, part, body=body: jax.lax.scan(body, carry, part)[0])(carry, part)
    return carry[0].actor


@functools.partial(jax.jit, static_argnums=0)
def run_episodes(env, actor, keys):
    """Returns the initial states and the search results of one episode for each key."""
    starts = jax.vmap(env.reset)(keys)
    config = Config(sac=SPHERE, env=ENV)

    def run_episode(start):
        args = SearchArgs(
            initial=episode_of(start).observation.view,
            band=jnp.array(probes.BAND),
            threshold=jnp.float32(ENV.threshold),
            task=sac.PolicyTask(actor, start),
        )
        return sac.search(jax.random.key(9), env.step, args, config)

    return starts, jax.vmap(run_episode)(starts)


def test_the_policy_finds_any_target_in_few_more_steps_than_the_lower_bound(actor):
    env = probes.SphereEnv(ENV)
    starts, result = run_episodes(env, actor, jax.random.split(jax.random.key(7), 500))
    end, is_found = result.end.state, np.asarray(result.score) >= ENV.threshold
    assert is_found.mean() >= 0.93  # the policy alone; no local search helps
    first = episode_of(starts)
    bound = jax.vmap(env.steps_lower_bound)(first.observation.view, first.target.view)
    steps = np.asarray(result.evaluations)
    assert (steps[is_found] >= np.asarray(bound)[is_found]).all()
    assert steps.mean() <= 1.6 * float(bound.mean())  # a random policy does not find the target in 20 steps
    # The result describes the end of the episode.
    np.testing.assert_array_equal(end.info["terminated"], is_found)
    np.testing.assert_array_equal(episode_of(end).num_steps, steps)
    np.testing.assert_allclose(result.view.elevation, episode_of(end).observation.view.elevation)
    assert (steps[~is_found] == ENV.episode_length).all()
    assert (np.asarray(result.unreachable) <= steps).all()
