"""The help that a policy gets where it goes in circles, with policies that are written down instead of trained."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax.envs.base import State

import probes
from vsearch_jax.config import Config
from vsearch_jax.geometry import wrap_angle
from vsearch_jax.search import SearchArgs, sac
from vsearch_jax.search.sac import policy
from vsearch_jax.types import Camera, EpisodeState, Observation, View

CONFIG = Config()
SCALE = math.radians(CONFIG.env.action_scale_deg)
TARGET = View(jnp.float32(0.3), jnp.float32(math.radians(55.0)))
NUM_EPISODES = 64


def start_at(view: View, aim: View) -> State:
    """The start of an episode whose policy heads for `aim`: the observation is the action that leads there."""
    camera = Camera(position=jnp.zeros(3), rotation=jnp.eye(3), fovy=jnp.ones(()))
    observation = Observation(view=view, qpos=jnp.stack([aim.azimuth, aim.elevation]), camera=camera, code=jnp.zeros(1))
    episode = EpisodeState(observation=observation, target=observation, num_steps=jnp.int32(0))
    info, zero = {"is_reachable": jnp.ones(())}, jnp.zeros(())
    return State(episode, head_for(view, observation.qpos), zero, zero, metrics_at(view), info)


def head_for(view: View, aim: jax.Array) -> jax.Array:
    way = jnp.stack([wrap_angle(aim[0] - view.azimuth), aim[1] - view.elevation])
    return jnp.clip(way / SCALE, -1.0, 1.0)


def metrics_at(view: View) -> dict[str, jax.Array]:
    return {"similarity": similarity(view), "joint_travel": jnp.float32(0.5), "motion_time": jnp.float32(2.0)}


def similarity(view: View) -> jax.Array:
    """0.98 at 3 degrees from the target, as a trained encoder has it, and flat far off."""
    azimuth, elevation = wrap_angle(view.azimuth - TARGET.azimuth), view.elevation - TARGET.elevation
    return jnp.exp(-0.0202 * (azimuth**2 + elevation**2) / math.radians(3.0) ** 2)


def step(state: State, action: jax.Array) -> State:
    episode = state.pipeline_state
    old = episode.observation.view
    view = View(wrap_angle(old.azimuth + SCALE * action[0]), old.elevation + SCALE * action[1])
    is_reachable = (view.elevation >= probes.BAND[0] - 1e-6) & (view.elevation <= probes.BAND[1] + 1e-6)
    view = jax.tree.map(lambda new, stay: jnp.where(is_reachable, new, stay), view, old)
    episode = episode.replace(observation=episode.observation.replace(view=view), num_steps=episode.num_steps + 1)
    info = {"is_reachable": is_reachable.astype(jnp.float32)}
    metrics = metrics_at(view)
    return state.replace(
        pipeline_state=episode, obs=head_for(view, episode.observation.qpos), metrics=metrics, info=info
    )


@pytest.fixture
def run(monkeypatch):
    """Returns the results of episodes from `starts` with policies that head for `aims`, each View of f32[N] rad."""
    monkeypatch.setattr(policy, "act", lambda key, actor, observation, config: observation)

    def episode(key, view, aim):
        start = start_at(view, aim)
        args = SearchArgs(view, jnp.array(probes.BAND), jnp.float32(CONFIG.env.threshold), sac.PolicyTask(None, start))
        return sac.search(key, step, args, CONFIG)

    return lambda starts, aims: jax.jit(jax.vmap(episode))(
        jax.random.split(jax.random.key(0), NUM_EPISODES), starts, aims
    )


def starts() -> View:
    return probes.random_views(jax.random.key(1), NUM_EPISODES)


def beside_target(degrees: float) -> View:
    angle = jnp.linspace(0.0, 2.0 * jnp.pi, NUM_EPISODES, endpoint=False)
    offset = math.radians(degrees)
    return View(TARGET.azimuth + offset * jnp.cos(angle), TARGET.elevation + offset * jnp.sin(angle))


def everywhere(view: View) -> View:
    return jax.tree.map(lambda x: jnp.full(NUM_EPISODES, x), view)


def test_a_policy_that_arrives_is_not_helped(run):
    result = run(starts(), everywhere(TARGET))
    assert (np.asarray(result.score) >= CONFIG.env.threshold).all()
    assert (np.asarray(result.end.num_helped) == 0).all()
    np.testing.assert_allclose(result.end.travel, 0.5 * np.asarray(result.evaluations))
    np.testing.assert_allclose(result.end.duration, 2.0 * np.asarray(result.evaluations))
    assert np.asarray(result.evaluations).max() <= 6


@pytest.mark.parametrize("degrees", [3.3, 4.5, 6.0])
def test_a_policy_that_stops_beside_the_target_is_led_there(run, degrees):
    result = run(starts(), beside_target(degrees))
    assert (np.asarray(result.score) >= CONFIG.env.threshold).all()
    helped = np.asarray(result.end.num_helped)
    assert (helped > 0).mean() > 0.8  # the others pass within reach on their way
    assert helped.mean() <= 5.0


def test_a_policy_that_stays_far_off_sweeps_until_it_sees_the_target(run):
    far = View(TARGET.azimuth + jnp.linspace(1.5, 4.5, NUM_EPISODES), jnp.full(NUM_EPISODES, TARGET.elevation))
    result = run(far, far)
    assert (np.asarray(result.end.num_helped) > 0).all()
    assert (np.asarray(result.best_scores[:, CONFIG.evaluation.patience - 1]) < 0.5).all()
    assert (np.asarray(result.best_scores[:, -1]) > 0.5).mean() > 0.9  # came by the target's side


def test_a_step_that_the_arm_cannot_do_is_not_repeated_for_ever(run):
    above = View(jnp.full(NUM_EPISODES, TARGET.azimuth), jnp.full(NUM_EPISODES, probes.BAND[1] + 1.0))
    top = View(starts().azimuth, jnp.full(NUM_EPISODES, probes.BAND[1]))
    result = run(top, above)
    # Without help all 20 steps would be out of reach; with it at most every second one is.
    assert (2 * np.asarray(result.unreachable) <= np.asarray(result.evaluations) + 1).all()
