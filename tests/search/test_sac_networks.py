"""The networks of soft actor-critic: what the shared layers read, and that all entries of an obs count."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vsearch_jax.config import SACConfig
from vsearch_jax.search.sac.networks import Actor, Critic, apply_network, init_network

CODE, JOINTS, SIZES = 6, 3, (2 * 6 + 3, 16, 8, 4)


@pytest.mark.parametrize("code_size", [0, CODE])
def test_every_entry_of_the_input_counts(code_size: int) -> None:
    params = init_network(jax.random.key(0), Actor, SIZES, code_size)
    jacobian = jax.jacobian(lambda obs: apply_network(Actor, SIZES, params, obs))(
        jax.random.normal(jax.random.key(1), (SIZES[0],))
    )
    assert jacobian.shape == (4, SIZES[0]) and np.abs(jacobian).max(axis=0).min() > 1e-4

    sizes = (SIZES[0] + 2, 16, 8, 1)
    critic = init_network(jax.random.key(2), Critic, sizes, code_size)
    obs, action = jnp.ones((5, SIZES[0])), jnp.zeros((5, 2))
    assert apply_network(Critic, sizes, critic, obs, action).shape == (5,)
    slope = jax.grad(lambda action: apply_network(Critic, sizes, critic, obs[0], action))(action[0])
    assert np.abs(slope).min() > 1e-5


def test_the_shared_layers_read_both_codes_alike() -> None:
    """The features are those of the present code and the difference of the target's. Swapped codes swap its sign."""
    params = init_network(jax.random.key(0), Actor, SIZES, CODE)
    first, second, joints = (jax.random.normal(jax.random.key(i), (size,)) for i, size in enumerate((CODE, CODE, 3)))
    width = SIZES[1]
    assert params["layers"][0]["kernel"].shape == (2 * width + JOINTS, SIZES[2])

    def features(*codes: jax.Array) -> np.ndarray:
        """Returns the input of the layer after the shared ones, read off through an identity matrix."""
        reader = init_network(jax.random.key(0), Actor, (SIZES[0], width, 2 * width + JOINTS), CODE)
        reader["layers"][0]["kernel"] = reader["layers"][0]["kernel"].replace(jnp.eye(2 * width + JOINTS))
        reader["pair"] = params["pair"]
        return np.asarray(
            apply_network(Actor, (SIZES[0], width, 2 * width + JOINTS), reader, jnp.concatenate([*codes, joints]))
        )

    forth, back, same = features(first, second), features(second, first), features(first, first)
    np.testing.assert_allclose(forth[width : 2 * width], -back[width : 2 * width], atol=1e-6)
    np.testing.assert_allclose(forth[:width] + forth[width : 2 * width], back[:width], atol=1e-6)
    np.testing.assert_allclose(same[width : 2 * width], 0.0, atol=1e-6)
    np.testing.assert_allclose(forth[2 * width :], joints, atol=1e-6)
    assert np.abs(forth[width : 2 * width]).max() > 0.01


def test_the_network_of_the_thesis_stays_selectable() -> None:
    assert SACConfig().network == "siamese"
    params = init_network(jax.random.key(0), Actor, SIZES, 0)
    assert params["layers"][0]["kernel"].shape == SIZES[:2] and "pair" not in params
