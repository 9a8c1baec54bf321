"""How the environment moves: by joints set, along a planned path, or by the arm's dynamics."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vsearch_jax as vs
from vsearch_jax.config import ConfigError, EnvConfig
from vsearch_jax.geometry import view_pose
from vsearch_jax.types import View

CONFIG = vs.Config.preset("smoke")


@pytest.fixture(scope="module")
def by_joints() -> vs.ViewSearchEnv:
    return vs.ViewSearchEnv(CONFIG)


def _moving(env: vs.ViewSearchEnv, **changes) -> vs.ViewSearchEnv:
    config = dataclasses.replace(CONFIG, env=dataclasses.replace(CONFIG.env, **changes))
    return vs.ViewSearchEnv(config, env.encoder, env.reach)


def _views(env: vs.ViewSearchEnv, count: int):
    """Views around the object, and the joints of the middle of the map."""
    views = View(jnp.linspace(-3.0, 3.0, count), jnp.full(count, jnp.mean(env.reach.band)))
    return views, env.reach.qpos[0, int(np.argmax(np.asarray(env.reach.is_reachable[0])))]


def _looks(env: vs.ViewSearchEnv, count: int):
    views, start = _views(env, count)
    sights, is_reachable = jax.jit(jax.vmap(lambda view: env.look(view, start)))(views)
    return views, sights, np.asarray(is_reachable)


def _errors(env: vs.ViewSearchEnv, views: View, sights) -> tuple[np.ndarray, np.ndarray]:
    wanted = jax.vmap(lambda view: view_pose(view, env.center, env.scene.radius))(views)
    position = np.linalg.norm(wanted.translation() - sights.camera.position, axis=-1)
    cosine = np.einsum("nij,nij->n", wanted.rotation().as_matrix(), sights.camera.rotation)
    return position, np.arccos(np.clip((cosine - 1) / 2, -1, 1))


def test_a_path_leads_where_kinematics_alone_does(by_joints):
    views, start = _views(by_joints, 8)
    qpos, first = jax.jit(jax.vmap(lambda view: by_joints.solve(view, start)))(views)
    _, by_path, second = _looks(_moving(by_joints, reachable="path"), 8)
    assert not np.any(second & ~np.asarray(first))
    assert second.sum() >= 7
    np.testing.assert_allclose(by_path.qpos[second], qpos[second], atol=1e-5)


@pytest.mark.slow
def test_dynamics_end_near_the_view(by_joints):
    env = _moving(by_joints, reachable="path", motion="dynamic")
    views, sights, is_reachable = _looks(env, 4)
    position, turn = _errors(env, views, sights)
    # The error of IK, 1 mm and 0.1 degrees, and that of the motion.
    assert np.all(position[is_reachable] < 2e-3) and np.all(turn[is_reachable] < np.deg2rad(0.3))


def test_dynamics_without_a_path_are_refused():
    with pytest.raises(ConfigError, match="kinematic where reachable is 'ik'"):
        EnvConfig(motion="dynamic")
