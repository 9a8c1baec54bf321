"""Measures of a finished search."""

from __future__ import annotations

import math
from typing import TypeAlias

import jax
import jax.numpy as jnp
from jax import Array

from vsearch_jax.env import FALSE_POSITIVE_DEG, ViewSearchEnv, pose_error
from vsearch_jax.geometry import symmetric_turn, turn_about_z
from vsearch_jax.types import Camera, Observation, SearchResult, View

Outcome: TypeAlias = dict[str, Array | View]
"""Measures of one or more finished searches, by name."""

_NUM_TURNS = 72
"""Number of turns that are tried for an object that looks the same after any turn."""


def measure_outcome(env: ViewSearchEnv, result: SearchResult, final: Observation, target: Observation) -> Outcome:
    """Measures one finished search: success, number of images, pose errors with respect to the target camera.

    Args:
      env: the task. Its threshold and the object's symmetry are read.
      result: the searcher's result.
      final: what the camera sees from the view that the search ends with.
      target: what the camera sees from the target view.

    Returns:
      Measures by name; `evaluate` describes them. `is_success` bool[], `evaluations` i32[], `final_cosine` f32[],
      `rotation_error` f32[] rad, `frobenius_angle` f32[] rad, `translation_error` f32[] m, `surface_distance` f32[] m,
      `is_false_positive` bool[],
      `unreachable` i32[], `best_scores` f32[G], G = the largest number of generations that the config allows;
      `target_view` View of f32[] rad, `final_qpos` and `target_qpos` f32[nq] rad or m.
    """
    rotation, frobenius, translation = pose_error(final.camera, target.camera, env.scene.symmetry, env.center)
    is_success = result.score >= env.config.env.threshold
    return {
        "is_success": is_success,
        "evaluations": result.evaluations,
        "final_cosine": result.score,
        "rotation_error": rotation,
        "frobenius_angle": frobenius,
        "translation_error": translation,
        "surface_distance": _surface_distance(env, final.camera, target.camera),
        "is_false_positive": is_success & (rotation > math.radians(FALSE_POSITIVE_DEG)),
        "unreachable": result.unreachable,
        "best_scores": result.best_scores,
        "target_view": target.view,
        "final_qpos": final.qpos,
        "target_qpos": target.qpos,
    }


def _surface_distance(env: ViewSearchEnv, camera: Camera, target: Camera) -> Array:
    """Returns the largest distance f32[] m between a point of the object seen from one camera and from the other.

    Both points are taken in the camera's frame. Of all turns that map a symmetric object to itself the best counts.
    This is the measure MSSD of the BOP benchmark (Hodan et al. 2020).
    """
    points, order = jnp.asarray(env.scene.object_points, jnp.float32), env.scene.symmetry
    seen = (points - camera.position[None]) @ camera.rotation
    turns = jnp.linspace(0.0, 2.0 * jnp.pi, order or _NUM_TURNS, endpoint=False)
    nearest = symmetric_turn(camera.rotation, target.rotation, order)

    def distance(turn: Array) -> Array:
        matrix = turn_about_z(nearest + turn)
        position = env.center + matrix @ (target.position - env.center)
        wanted = (points - position[None]) @ (matrix @ target.rotation)
        return jnp.sqrt(jnp.max(jnp.sum((seen - wanted) ** 2, axis=-1)))

    return jnp.min(jax.lax.map(distance, turns))
