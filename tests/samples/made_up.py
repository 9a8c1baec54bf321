"""Made-up results of an evaluation and a made-up reachability map, for tests of the code that uses them."""

from typing import Any

import jax.numpy as jnp
import numpy as np

from vsearch_jax.types import ReachabilityMap, View


def trials(shape: tuple[int, ...], generations: int, seed: int = 0) -> dict[str, Any]:
    """Returns made-up measures of one searcher, as `evaluate` gives them.

    Args:
      shape: [trials] or [seeds, episodes].
      generations: length of `best_scores`.
      seed: of the random values.
    """
    random = np.random.default_rng(seed)
    is_success = random.random(shape) < 0.9
    rotation = np.where(is_success, random.gamma(2.0, 0.03, shape), 2.5).astype(np.float32)
    best = np.sort(random.random((*shape, generations)) ** 0.2, axis=-1).astype(np.float32)
    view = View(jnp.asarray(random.random(shape), jnp.float32), jnp.asarray(random.random(shape), jnp.float32))
    return {
        "is_success": is_success,
        "evaluations": random.integers(2, 10 * generations, shape).astype(np.int32),
        "final_cosine": best[..., -1],
        "rotation_error": rotation,
        "frobenius_angle": rotation / 2,
        "translation_error": 0.35 * rotation,
        "surface_distance": 0.1 * rotation,
        "is_false_positive": is_success & (rotation > np.deg2rad(10)),
        "unreachable": random.integers(0, 2, shape).astype(np.int32),
        "best_scores": best,
        "joint_travel": random.gamma(4.0, 2.0, shape).astype(np.float32),
        "motion_time": random.gamma(4.0, 5.0, shape).astype(np.float32),
        "num_plans": random.integers(1, 10 * generations, shape).astype(np.int32),
        "initial_view": view,
        "target_view": view,
        "final_qpos": random.random((*shape, 7)).astype(np.float32),
        "target_qpos": random.random((*shape, 7)).astype(np.float32),
    }


def evaluation(num_seeds: int = 1) -> dict[str, Any]:
    """Returns a made-up result of `evaluate`: 24 trials of each black-box searcher, 40 episodes of each policy."""
    shape = (num_seeds, 40)
    steps = {"evaluations": np.full(shape, 4), "steps_lower_bound": np.full(shape, 3)}
    policies = trials(shape, 20) | steps
    count = np.arange(24, dtype=np.int32) % 3
    return {
        "random_search": trials((24,), 30) | {"num_wide": count},
        "cma_es": trials((24,), 30, 1),
        "cma_es_restarts": trials((24,), 30, 2) | {"num_restarts": count, "scan_images": 20 + count},
        "sac": policies,
        "sac_assisted": policies | {"num_helped": (np.arange(np.prod(shape)).reshape(shape) % 4 == 0).astype(np.int32)},
    }


def search() -> dict[str, Any]:
    """Returns a made-up result of `record_search`: the search ends after two steps."""
    images = np.random.default_rng(2).random((21, 16, 16, 3)).astype(np.float32)
    return {"images": images, "similarity": np.linspace(0.1, 1.0, 21), "target": images[2], "num_steps": np.int32(2)}


def reach() -> ReachabilityMap:
    """Returns a map with the band from 45 to 60 degrees; only cells at these elevations are reachable."""
    elevations = jnp.linspace(0, jnp.pi / 2, 7)
    return ReachabilityMap(
        azimuths=jnp.linspace(0, 2 * jnp.pi, 12, endpoint=False),
        elevations=elevations,
        is_reachable=jnp.broadcast_to((elevations > 0.6) & (elevations < 1.3), (12, 7)),
        qpos=jnp.zeros((12, 7, 9)),
        band=jnp.asarray([0.785, 1.047]),
    )
