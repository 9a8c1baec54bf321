import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import probes
from vsearch_jax.config import Config, EnvConfig, SACConfig
from vsearch_jax.search import SearchArgs, sac
from vsearch_jax.types import SACState, Transition

SMALL = SACConfig(hidden_sizes=(8, 8), batch_size=4, discount=0.9)
ENV = EnvConfig()


update = jax.jit(sac.update, static_argnames="config")
td_target = jax.jit(sac.td_target, static_argnames="config")
init = jax.jit(sac.init, static_argnames=("config", "observation_size"))


def transitions(reward, terminated, truncated, size=6) -> Transition:
    num = len(reward)
    observation = jax.random.normal(jax.random.key(11), (2, num, size))
    return Transition(
        obs=observation[0],
        action=jnp.full((num, 2), 0.5),
        reward=jnp.asarray(reward, jnp.float32),
        next_obs=observation[1],
        terminated=jnp.asarray(terminated, jnp.float32),
        truncated=jnp.asarray(truncated, jnp.float32),
        is_reachable=jnp.ones(num),
    )


def with_constant_values(state: SACState, values: tuple[float, float]) -> SACState:
    """Target critics that are `values` everywhere."""
    target_critic = jax.tree.map(jnp.zeros_like, state.target_critic)
    last = len(SMALL.hidden_sizes)
    target_critic["layers"][last]["bias"] = target_critic["layers"][last]["bias"].replace(jnp.asarray(values)[:, None])
    return state.replace(target_critic=target_critic)


# -- the targets and the update, by hand ----------------------------------------------------------------------------


def test_the_target_takes_the_smaller_critic_and_only_termination_cuts_it():
    state = with_constant_values(init(jax.random.key(0), SMALL, 6), (5.0, 3.0))
    state = state.replace(log_alpha=jnp.asarray(-jnp.inf))  # no entropy in the value
    batch = transitions([1.0, 1.0, 1.0], terminated=[0, 1, 0], truncated=[0, 0, 1])
    target = td_target(jax.random.key(1), state, batch, SMALL)
    np.testing.assert_allclose(target, [1.0 + 0.9 * 3.0, 1.0, 1.0 + 0.9 * 3.0], rtol=1e-6)


def test_the_target_pays_for_the_entropy_of_the_next_action():
    """Mean over actions: the soft value is min Q + alpha H, H by numerical integration of the density."""
    state = with_constant_values(init(jax.random.key(0), SMALL, 6), (0.0, 0.0))
    actor = jax.tree.map(jnp.zeros_like, state.actor)  # mean 0, standard deviation softplus(0) + 0.001 before tanh
    state = state.replace(actor=actor, log_alpha=jnp.zeros(()))
    num = 20_000
    batch = transitions([0.0] * num, [0] * num, [0] * num)
    target = td_target(jax.random.key(1), state, batch, dataclasses.replace(SMALL, discount=1.0))
    raw = np.linspace(-8.0, 8.0, 20_001)
    std = np.log(2.0) + 0.001
    density = np.exp(-0.5 * (raw / std) ** 2) / (std * np.sqrt(2.0 * np.pi))
    log_density = np.log(density) - np.log(1.0 - np.tanh(raw) ** 2)
    entropy = 2.0 * -np.sum(density * log_density) * (raw[1] - raw[0])
    assert float(target.mean()) == pytest.approx(entropy, abs=0.03)


def test_an_update_moves_the_target_critics_by_tau_and_raises_a_temperature_that_is_too_low():
    state = init(jax.random.key(0), SMALL, 6)
    batch = transitions([1.0, 0.0, -1.0, 0.5], [0, 1, 0, 0], [0, 0, 1, 0])
    config = dataclasses.replace(SMALL, tau=0.25)
    new, metrics = update(jax.random.key(1), state, batch, config)
    expected = jax.tree.map(lambda old, now: 0.75 * old + 0.25 * now, state.target_critic, new.critic)
    jax.tree.map(functools.partial(np.testing.assert_allclose, atol=1e-6), new.target_critic, expected)
    assert float(new.log_alpha) < float(state.log_alpha)  # entropy of a new policy is above -2 nats an entry
    greedy = dataclasses.replace(config, target_entropy=0.69)
    assert float(update(jax.random.key(1), state, batch, greedy)[0].log_alpha) > float(state.log_alpha)
    assert all(np.isfinite(value) for value in metrics.values())


def test_the_step_size_falls_to_zero_over_the_run():
    config = dataclasses.replace(SMALL, num_environment_steps=80, num_warmup_steps=16, updates_per_step=0.25)
    state = init(jax.random.key(0), config, 6)
    batch = transitions([1.0, 0.0, -1.0, 0.5], [0, 1, 0, 0], [0, 0, 1, 0])
    steps = []
    for i in range(17):  # 16 updates belong to the run
        new, _ = update(jax.random.key(i), state, batch, config)
        changes = jax.tree.map(lambda a, b: np.abs(np.asarray(a) - np.asarray(b)).max(), new.actor, state.actor)
        steps.append(max(jax.tree.leaves(changes)))
        state = new
    assert steps[16] == 0.0
    assert 0.0 < steps[15] < 0.3 * steps[0]


def test_the_mean_action_is_deterministic_and_random_ones_are_not():
    state = init(jax.random.key(0), SMALL, 6)
    observation = jnp.ones((3, 6))
    mean = sac.act(None, state.actor, observation, SMALL)
    first, second = (sac.act(jax.random.key(i), state.actor, observation, SMALL) for i in range(2))
    assert mean.shape == (3, 2)
    assert np.abs(first).max() <= 1.0
    assert not np.allclose(first, second)


# -- relabelling ----------------------------------------------------------------------------------------------------

E0, E1 = jnp.asarray([2.0, 0.0, 0.0, 0.0]), jnp.asarray([0.0, 2.0, 0.0, 0.0])


def one_transition(code, target, next_code, *, is_reachable=1.0, reward=0.0, num=600) -> Transition:
    joints = jnp.arange(3.0)
    row = Transition(
        obs=jnp.concatenate([code, target, joints]),
        action=jnp.zeros(2),
        reward=jnp.asarray(reward),
        next_obs=jnp.concatenate([next_code, target, joints + 1.0]),
        terminated=jnp.asarray(0.0),
        truncated=jnp.asarray(1.0),
        is_reachable=jnp.asarray(is_reachable),
    )
    return jax.tree.map(lambda x: jnp.broadcast_to(x, (num, *x.shape)), row)


def test_relabelling_keeps_a_fifth_and_splits_the_rest_in_thirds():
    batch = one_transition(E0, -E0, E1, reward=-1.0)
    diagonal = (E0 + E1) / jnp.sqrt(2.0)
    out = sac.relabel(jax.random.key(0), batch, diagonal[None], ENV, SMALL)
    target = np.asarray(out.observation[:, 4:8])
    kinds = {name: (np.abs(target - np.asarray(code)) < 1e-6).all(axis=1) for name, code in
             (("kept", -E0), ("other", diagonal), ("own", E1))}  # fmt: skip
    rates = {name: kind.mean() for name, kind in kinds.items()}
    assert rates == pytest.approx({"kept": 0.2, "other": 0.8 * 2 / 3, "own": 0.8 / 3}, abs=0.06)
    assert sum(rates.values()) == pytest.approx(1.0)
    expected = {"kept": (-1.0, 0.0, 1.0), "other": (np.sqrt(0.5) - 1.0, 0.0, 1.0), "own": (2.0, 1.0, 0.0)}
    for name, (reward, terminated, truncated) in expected.items():
        np.testing.assert_allclose(out.reward[kinds[name]], reward, atol=1e-6)
        np.testing.assert_array_equal(out.terminated[kinds[name]], terminated)
        np.testing.assert_array_equal(out.truncated[kinds[name]], truncated)


def test_relabelling_changes_the_target_alone_and_in_both_observations():
    batch = one_transition(E0, -E0, E1)
    out = sac.relabel(jax.random.key(0), batch, E0[None], ENV, SMALL)
    np.testing.assert_array_equal(out.observation[:, 4:8], out.next_obs[:, 4:8])
    for name in ("observation", "next_obs"):
        np.testing.assert_array_equal(getattr(out, name)[:, :4], getattr(batch, name)[:, :4])
        np.testing.assert_array_equal(getattr(out, name)[:, 8:], getattr(batch, name)[:, 8:])


def test_an_unreachable_step_keeps_its_reward_and_ends_nowhere_even_where_it_stands_on_the_target():
    batch = one_transition(E1, -E0, E1, is_reachable=0.0, reward=-2.0)
    out = sac.relabel(jax.random.key(0), batch, E1[None], ENV, SMALL)
    assert (np.asarray(out.observation[:, 5]) == 2.0).any()  # some were given the code they stand on
    np.testing.assert_array_equal(out.reward, -2.0)
    np.testing.assert_array_equal(out.terminated, 0.0)


def test_rewards_equal_the_environments_where_nothing_is_relabelled():
    env = probes.SphereEnv(ENV)
    states = jax.vmap(env.reset)(jax.random.split(jax.random.key(0), 200))
    actions = jax.random.uniform(jax.random.key(1), (200, 2), minval=-1.0, maxval=1.0)
    ends = jax.vmap(env.step)(states, actions)
    batch = collect(states, actions, ends)
    assert 0.0 < float(batch.is_reachable.mean()) < 1.0
    kept = dataclasses.replace(SMALL, relabel_fraction=0.0)
    out = sac.relabel(jax.random.key(2), batch, states.pipeline_state.target.code, ENV, kept)
    jax.tree.map(functools.partial(np.testing.assert_allclose, atol=1e-5), out, batch)


# -- replay ---------------------------------------------------------------------------------------------------------


def test_the_replay_overwrites_the_oldest_and_samples_only_what_is_there():
    def rows(values):
        return Transition(*(jnp.asarray(values, jnp.float32) for _ in Transition._fields))

    replay = sac.init_replay(Transition(*(jnp.zeros(()) for _ in Transition._fields)), 5)
    replay = sac.insert(replay, rows([1, 2]))
    seen = set(np.asarray(sac.sample_batch(jax.random.key(0), replay, 64).reward).tolist())
    assert seen == {1.0, 2.0}
    replay = sac.insert(sac.insert(replay, rows([3, 4])), rows([5, 6]))
    seen = np.asarray(sac.sample_batch(jax.random.key(0), replay, 2000).reward)
    values, counts = np.unique(seen, return_counts=True)
    assert values.tolist() == [2.0, 3.0, 4.0, 5.0, 6.0]
    assert counts.min() > 300  # uniform: 400 each, standard deviation 18


# -- problems with a known answer -----------------------------------------------------------------------------------


def train_on(config: SACConfig, make_batch, num_updates: int, observation_size: int) -> SACState:
    def one(i, state):
        sample_key, update_key = jax.random.split(jax.random.fold_in(jax.random.key(5), i))
        return sac.update(update_key, state, make_batch(sample_key), config)[0]

    state = init(jax.random.key(4), config, observation_size)
    return jax.jit(lambda state: jax.lax.fori_loop(0, num_updates, one, state))(state)


def bandit_batch(key, terminated=1.0) -> Transition:
    """Reward -(a - s)^2 summed over the two entries: the best action is the observation itself."""
    key_state, key_action = jax.random.split(key)
    observation = jax.random.uniform(key_state, (64, 2), minval=-0.7, maxval=0.7)
    action = jax.random.uniform(key_action, (64, 2), minval=-1.0, maxval=1.0)
    flag = jnp.full((64,), terminated)
    reward = -jnp.sum((action - observation) ** 2, axis=-1)
    return Transition(observation, action, reward, observation, flag, 1.0 - flag, jnp.ones(64))


PROBE = SACConfig(
    hidden_sizes=(32, 32), num_environment_steps=2512, initial_temperature=0.01, learning_rate=3e-3, target_entropy=-3.0
)


def test_a_bandit_with_a_continuum_of_contexts_is_solved():
    state = train_on(PROBE, bandit_batch, 2000, 2)
    observation = jax.random.uniform(jax.random.key(9), (100, 2), minval=-0.7, maxval=0.7)
    action = sac.act(None, state.actor, observation, PROBE)
    assert float(jnp.abs(action - observation).mean()) < 0.1  # 0.6 for an untrained policy


def test_values_go_on_past_truncation_and_stop_at_termination():
    """With reward 1 for ever the value is 1 / (1 - discount); where every step terminates it is 1."""
    config = dataclasses.replace(PROBE, discount=0.5, tau=0.1, initial_temperature=1e-6)

    def batch(key, terminated):
        return bandit_batch(key, terminated)._replace(reward=jnp.ones(64))

    for terminated, value in ((0.0, 2.0), (1.0, 1.0)):
        state = train_on(config, functools.partial(batch, terminated=terminated), 500, 2)
        probe = batch(jax.random.key(3), 0.0)._replace(reward=jnp.zeros(64))
        target = td_target(jax.random.key(0), state, probe, config)
        np.testing.assert_allclose(target, 0.5 * value, atol=0.1)


# -- the task, in small ---------------------------------------------------------------------------------------------

TASK = SACConfig(
    hidden_sizes=(64, 64), batch_size=64, num_environment_steps=4096, num_warmup_steps=512, updates_per_step=2.0,
    learning_rate=2e-3,
)  # fmt: skip


def collect(states, actions, ends) -> Transition:
    info = ends.info
    return Transition(
        states.obs, actions, ends.reward, ends.obs, info["terminated"], info["truncated"], info["is_reachable"]
    )


def iteration(env, carry, key, *, is_warm):
    state, states, replay = carry
    act_key, restart_key, update_key = jax.random.split(key, 3)
    actions = sac.act(act_key, state.actor, states.obs, TASK)
    if not is_warm:
        actions = jax.random.uniform(act_key, actions.shape, minval=-1.0, maxval=1.0)
    ends = jax.vmap(env.step)(states, actions)
    replay = sac.insert(replay, collect(states, actions, ends))
    is_ended = ends.info["terminated"] + ends.info["truncated"] > 0
    fresh = jax.vmap(env.reset)(jax.random.split(restart_key, TASK.num_envs))
    states = jax.tree.map(lambda a, b: jax.vmap(jnp.where)(is_ended, a, b), fresh, ends)

    def one_update(i, state):
        sample_key, relabel_key, key = jax.random.split(jax.random.fold_in(update_key, i), 3)
        batch = sac.sample_batch(sample_key, replay, TASK.batch_size)
        codes = batch.next_obs[:, :48]
        return sac.update(key, state, sac.relabel(relabel_key, batch, codes, ENV, TASK), TASK)[0]

    if is_warm:
        state = jax.lax.fori_loop(0, int(TASK.num_envs * TASK.updates_per_step), one_update, state)
    return (state, states, replay), None


@pytest.fixture(scope="module")
def policy():
    env = probes.SphereEnv(ENV)
    states = jax.vmap(env.reset)(jax.random.split(jax.random.key(0), TASK.num_envs))
    state = init(jax.random.key(1), TASK, env.observation_size)
    example = collect(states, jnp.zeros((TASK.num_envs, 2)), states)
    replay = sac.init_replay(jax.tree.map(lambda x: x[0], example), TASK.num_environment_steps)
    carry = (state, states, replay)
    num_warm = TASK.num_warmup_steps // TASK.num_envs
    keys = jax.random.split(jax.random.key(2), TASK.num_environment_steps // TASK.num_envs)
    for is_warm, part in ((False, keys[:num_warm]), (True, keys[num_warm:])):
        body = functools.partial(iteration, env, is_warm=is_warm)
        carry = jax.jit(lambda carry, part, body=body: jax.lax.scan(body, carry, part)[0])(carry, part)
    return carry[0].actor


@functools.partial(jax.jit, static_argnums=0)
def episodes(env, actor, keys):
    starts = jax.vmap(env.reset)(keys)
    config = Config(sac=TASK, env=ENV)

    def run(start):
        args = SearchArgs(
            initial=start.pipeline_state.observation.view,
            band=jnp.array(probes.BAND),
            threshold=jnp.float32(ENV.threshold),
            task=sac.PolicyTask(actor, start),
        )
        return sac.search(jax.random.key(9), env.step, args, config)

    return starts, jax.vmap(run)(starts)


def test_the_policy_finds_any_target_in_few_more_steps_than_the_bound(policy):
    env = probes.SphereEnv(ENV)
    starts, result = episodes(env, policy, jax.random.split(jax.random.key(7), 500))
    ends, is_found = result.end.state, np.asarray(result.score) >= ENV.threshold
    assert is_found.mean() >= 0.93
    initial, target = starts.pipeline_state.observation.view, starts.pipeline_state.target.view
    bound = jax.vmap(env.steps_lower_bound)(initial, target)
    steps = np.asarray(result.evaluations)
    assert (steps[is_found] >= np.asarray(bound)[is_found]).all()
    assert steps.mean() <= 1.6 * float(bound.mean())  # a random policy fails within the 20 steps
    # The result is the end of the episode.
    np.testing.assert_array_equal(ends.info["terminated"], is_found)
    np.testing.assert_array_equal(ends.pipeline_state.num_steps, steps)
    np.testing.assert_allclose(result.view.elevation, ends.pipeline_state.observation.view.elevation)
    assert (steps[~is_found] == ENV.episode_length).all()
    assert (np.asarray(result.unreachable) <= steps).all()
