"""Measures of a finished search."""

from __future__ import annotations

import math
from typing import TypeAlias

from jax import Array

from vsearch_jax.env import FALSE_POSITIVE_DEG, ViewSearchEnv, pose_error
from vsearch_jax.types import Observation, SearchResult, View

Outcome: TypeAlias = dict[str, Array | View]
"""Measures of one or more finished searches, by name."""


def measure_outcome(env: ViewSearchEnv, result: SearchResult, final: Observation, target: Observation) -> Outcome:
    """Measures one finished search: success, number of images, pose errors with respect to the target camera.

    Args:
      env: the task. Its threshold and the object's symmetry are read.
      result: the searcher's result.
      final: what the camera sees from the view that the search ends with.
      target: what the camera sees from the target view.

    Returns:
      Measures by name; `evaluate` describes them. `is_success` bool[], `evaluations` i32[], `final_cosine` f32[],
      `rotation_error` f32[] rad, `frobenius_angle` f32[] rad, `translation_error` f32[] m, `is_false_positive` bool[],
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
        "is_false_positive": is_success & (rotation > math.radians(FALSE_POSITIVE_DEG)),
        "unreachable": result.unreachable,
        "best_scores": result.best_scores,
        "target_view": target.view,
        "final_qpos": final.qpos,
        "target_qpos": target.qpos,
    }
