"""Goal relabelling and the replay buffer."""

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
from vsearch_jax.types import Transition

CONFIG = SACConfig()
ENV = EnvConfig()
E0, E1 = jnp.asarray([2.0, 0.0, 0.0, 0.0]), jnp.asarray([0.0, 2.0, 0.0, 0.0])


def repeated_transition(code, target, next_code, *, is_reachable=1.0, reward=0.0, num=600) -> Transition:
    """Returns a batch of `num` equal transitions that do not terminate."""
    qpos = jnp.arange(3.0)
    row = Transition(
        obs=jnp.concatenate([code, target, qpos]),
        action=jnp.zeros(2),
        reward=jnp.asarray(reward),
        next_obs=jnp.concatenate([next_code, target, qpos + 1.0]),
        terminated=jnp.asarray(0.0),
        is_reachable=jnp.asarray(is_reachable),
    )
    return jax.tree.map(lambda x: jnp.broadcast_to(x, (num, *x.shape)), row)


def test_a_fifth_keeps_its_target_and_the_rest_gets_candidates_and_own_codes_two_to_one():
    batch = repeated_transition(E0, -E0, E1, reward=-1.0)
    diagonal = (E0 + E1) / jnp.sqrt(2.0)
    out = sac.relabel(jax.random.key(0), batch, diagonal[None], ENV, CONFIG)
    target = np.asarray(out.obs[:, 4:8])
    codes = {"kept": -E0, "candidate": diagonal, "own": E1}
    kinds = {name: (np.abs(target - np.asarray(code)) < 1e-6).all(axis=1) for name, code in codes.items()}
    rates = {name: kind.mean() for name, kind in kinds.items()}
    assert rates == pytest.approx({"kept": 0.2, "candidate": 0.8 * 2 / 3, "own": 0.8 / 3}, abs=0.06)
    assert sum(rates.values()) == pytest.approx(1.0)
    expected = {"kept": (-1.0, 0.0), "candidate": (np.sqrt(0.5) - 1.0, 0.0), "own": (2.0, 1.0)}
    for name, (reward, terminated) in expected.items():
        np.testing.assert_allclose(out.reward[kinds[name]], reward, atol=1e-6)
        np.testing.assert_array_equal(out.terminated[kinds[name]], terminated)


def test_relabelling_changes_only_the_target_and_does_so_in_obs_and_next_obs():
    batch = repeated_transition(E0, -E0, E1)
    out = sac.relabel(jax.random.key(0), batch, E0[None], ENV, CONFIG)
    np.testing.assert_array_equal(out.obs[:, 4:8], out.next_obs[:, 4:8])
    for name in ("obs", "next_obs"):
        np.testing.assert_array_equal(getattr(out, name)[:, :4], getattr(batch, name)[:, :4])
        np.testing.assert_array_equal(getattr(out, name)[:, 8:], getattr(batch, name)[:, 8:])


def test_an_unreachable_step_keeps_its_reward_and_does_not_terminate_even_at_the_target():
    batch = repeated_transition(E1, -E0, E1, is_reachable=0.0, reward=-2.0)
    out = sac.relabel(jax.random.key(0), batch, E1[None], ENV, CONFIG)
    assert (np.asarray(out.obs[:, 5]) == 2.0).any()  # in some transitions the new target is the present code
    np.testing.assert_array_equal(out.reward, -2.0)
    np.testing.assert_array_equal(out.terminated, 0.0)


def test_without_new_targets_relabelling_gives_the_rewards_of_the_environment():
    env = probes.SphereEnv(ENV)
    states = jax.vmap(env.reset)(jax.random.split(jax.random.key(0), 200))
    actions = jax.random.uniform(jax.random.key(1), (200, 2), minval=-1.0, maxval=1.0)
    batch = transition_of(states, actions, jax.vmap(env.step)(states, actions))
    assert 0.0 < float(batch.is_reachable.mean()) < 1.0
    config = dataclasses.replace(CONFIG, relabel_fraction=0.0)
    out = sac.relabel(jax.random.key(2), batch, episode_of(states).target.code, ENV, config)
    jax.tree.map(functools.partial(np.testing.assert_allclose, atol=1e-5), out, batch)


def test_the_buffer_overwrites_the_oldest_transitions_and_samples_only_inserted_ones():
    def batch_of(values):
        return Transition(*(jnp.asarray(values, jnp.float32) for _ in Transition._fields))

    replay = sac.init_replay(Transition(*(jnp.zeros(()) for _ in Transition._fields)), 5)
    replay = sac.insert(replay, batch_of([1, 2]))
    drawn = set(np.asarray(sac.sample_batch(jax.random.key(0), replay, 64).reward).tolist())
    assert drawn == {1.0, 2.0}
    replay = sac.insert(sac.insert(replay, batch_of([3, 4])), batch_of([5, 6]))
    drawn = np.asarray(sac.sample_batch(jax.random.key(0), replay, 2000).reward)
    values, counts = np.unique(drawn, return_counts=True)
    assert values.tolist() == [2.0, 3.0, 4.0, 5.0, 6.0]
    assert counts.min() > 300  # the mean is 400, the standard deviation 18
