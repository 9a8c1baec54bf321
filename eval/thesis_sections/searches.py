"""The thesis's experiments with random search and CMA-ES, each as one jitted call."""

from __future__ import annotations

import functools
from typing import NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

import vsearch_jax as vs
from thesis_sections.published import TABLE_5_1, TABLE_5_2
from vsearch_jax.config import CMAESConfig, Config, RandomSearchConfig
from vsearch_jax.env import pose_error
from vsearch_jax.evaluation import initial_views
from vsearch_jax.evaluation.outcome import Outcome
from vsearch_jax.evaluation.protocol import check_reached
from vsearch_jax.evaluation.trials import search_trials
from vsearch_jax.evaluation.views import ViewRequest, observe_request
from vsearch_jax.geometry import cosine_similarity, wrap_angle
from vsearch_jax.search import cma_es, cma_es_restarts, random_search
from vsearch_jax.types import Observation, TrainState, View
from vsearch_jax.xla.batching import map_in_batches

Searcher: TypeAlias = tuple[str, RandomSearchConfig | CMAESConfig]
"""Name of a module of `vsearch_jax.search`, and its settings."""

_METHODS = {
    "random_search": random_search.method,
    "cma_es": cma_es.method,
    "cma_es_restarts": cma_es_restarts.method,
}
WIDE_SWEEP = (0, 1, 2, 3, 5)
"""Numbers of samples in ten of random search that are uniform over the band."""
_PENALTY_ELEVATION_DEG = 45.0
"""Elevation of the target of table 5.2. There, turns of 130 to 170 degrees are 45 to 49 cm, as in the thesis."""


class Experiment(NamedTuple):
    """Several searchers from the same initial views to one target.

    Attributes:
      searchers: {label: searcher}.
      initial_deg: azimuths and elevations of the initial views in degrees.
      target_deg: azimuth and elevation of the target in degrees.
      num_runs: number of runs of each searcher from each initial view.
    """

    searchers: dict[str, Searcher]
    initial_deg: tuple[tuple[float, float], ...]
    target_deg: tuple[float, float]
    num_runs: int


def experiments(config: Config, band_deg: tuple[float, float], num_runs: int) -> dict[str, Experiment]:
    """Returns the experiments of thesis 5.1 to 5.4 by name, and the sweep of our wide samples of random search.

    Args:
      config: the config of the run that gives the encoder.
      band_deg: lowest and highest reachable elevation in degrees.
      num_runs: number of runs from each initial view; the thesis has 10.
    """
    target = (config.evaluation.target_azimuth_deg, config.evaluation.target_elevation_deg)
    thesis_rule = RandomSearchConfig(num_wide=0)
    low, high = band_deg
    six = tuple((60.0 * i + 30.0, low + (high - low) * (2 * (i % 3) + 1) / 6) for i in range(6))
    views = initial_views(Config(), jnp.deg2rad(jnp.asarray(band_deg)))
    twelve = tuple(zip(np.rad2deg(views.azimuth).tolist(), np.rad2deg(views.elevation).tolist(), strict=True))
    turned = tuple((target[0] + degrees, _PENALTY_ELEVATION_DEG) for _, degrees, _, _ in TABLE_5_2)
    return {
        "k_sweep": Experiment(
            {f"k {k:g}": ("random_search", RandomSearchConfig(k=k, num_wide=0)) for k in TABLE_5_1},
            six,
            target,
            num_runs,
        ),
        "wide_sweep": Experiment(
            {f"wide {wide}": ("random_search", RandomSearchConfig(num_wide=wide)) for wide in WIDE_SWEEP},
            twelve,
            target,
            num_runs,
        ),
        "repeats": Experiment(
            {
                "random_search": ("random_search", thesis_rule),
                "cma_es": ("cma_es", config.cma_es),
                "cma_es_restarts": ("cma_es_restarts", config.cma_es),
            },
            twelve,
            target,
            num_runs,
        ),
        "penalty": Experiment(
            {
                "penalty": ("cma_es", CMAESConfig(constraint="penalty")),
                "bounds": ("cma_es", config.cma_es),
                "bounds_restarts": ("cma_es_restarts", config.cma_es),
            },
            turned,
            (target[0], _PENALTY_ELEVATION_DEG),
            num_runs,
        ),
    }


def run_experiment(state: TrainState, config: Config, experiment: Experiment) -> dict[str, dict[str, np.ndarray]]:
    """Runs an experiment.

    Args:
      state: a trained state; its encoder is used.
      config: the config of the training.
      experiment: what to run.

    Returns:
      {label: measures by name}. Each measure is an array of [initial views, runs, ...]; `vsearch_jax.evaluate`
      describes them. `initial_cosine`, `initial_rotation_error` in rad and `initial_translation_error` in m are those
      of the initial view.

    Raises:
      UnreachableError: inverse kinematics finds no joints for the target view.
    """
    views = (np.deg2rad(np.array(experiment.initial_deg)), np.deg2rad(np.array(experiment.target_deg)))
    views = tuple(View(wrap_angle(jnp.float32(x.T[0])), jnp.float32(x.T[1])) for x in views)
    outcomes, is_reached = _run(state, *views, config, tuple(experiment.searchers.values()), experiment.num_runs)
    check_reached(is_reached, experiment.target_deg, state.reach)
    shape = (len(experiment.initial_deg), experiment.num_runs)
    return {
        label: {
            name: np.asarray(x).reshape(*shape, *x.shape[1:]) for name, x in outcome.items() if not isinstance(x, View)
        }
        for label, outcome in zip(experiment.searchers, outcomes, strict=True)
    }


@functools.partial(jax.jit, static_argnames=("config", "searchers", "num_runs"))
def _run(
    state: TrainState, initial: View, target: View, config: Config, searchers: tuple[Searcher, ...], num_runs: int
) -> tuple[list[Outcome], Array]:
    """Runs the searchers `num_runs` times from each initial view; the views are of f32[V] rad and f32[] rad.

    Returns the measures of each searcher; and bool[], whether the camera was at the target view.
    """
    env = vs.ViewSearchEnv(config, state.encoder, state.reach)
    joints_key, search_key = jax.random.split(jax.random.fold_in(state.key, 2**31 - 3))  # a salt of its own
    views = jax.tree.map(lambda x, y: jnp.append(jnp.repeat(x, num_runs), y), initial, target)
    count = views.azimuth.shape[0]
    joints = jax.vmap(env.random_joints)(jax.random.split(joints_key, count))
    requests = ViewRequest(views, joints, jnp.ones(count, bool))
    seen = map_in_batches(functools.partial(observe_request, env), requests, config.evaluation.batch_size)
    start, end = jax.tree.map(lambda x: x[:-1], seen), jax.tree.map(lambda x: x[-1], seen)
    methods = tuple(_METHODS[name](settings) for name, settings in searchers)
    keys = jax.random.split(search_key, len(methods))
    outcomes = search_trials(keys, env, methods, start, end.observation)
    errors = _initial_errors(env, start.observation, end.observation)
    return [outcome | errors for outcome in outcomes], end.is_reached


def _initial_errors(env: vs.ViewSearchEnv, start: Observation, end: Observation) -> dict[str, Array]:
    """Returns cosine and pose errors of the initial views, f32[N] each."""
    rotation, _, translation = jax.vmap(lambda camera: pose_error(camera, end.camera, env.scene.symmetry, env.center))(
        start.camera
    )
    cosine = jax.vmap(lambda code: cosine_similarity(code, end.code))(start.code)
    return {
        "initial_cosine": cosine,
        "initial_rotation_error": rotation,
        "initial_translation_error": translation,
    }
