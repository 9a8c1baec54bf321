"""Measures of a finished search."""

from __future__ import annotations

import math
from typing import TypeAlias

from jax import Array

from vsearch_jax.env import FALSE_POSITIVE_DEG, ViewSearchEnv, pose_error
from vsearch_jax.types import Camera, SearchResult, View

Outcome: TypeAlias = dict[str, Array | View]
"""Measures of one or more finished searches, by name."""


def measure_outcome(env: ViewSearchEnv, result: SearchResult, camera: Camera, target: Camera) -> Outcome:
    """Measures one finished search: success, number of images, pose errors with respect to the target camera.

    Args:
      env: the task. Its threshold and the object's symmetry are read.
      result: the searcher's result.
      camera: camera in world at the end of the search.
      target: camera in world at the target view.

    Returns:
      Measures by name; `evaluate` describes them. `is_success` bool[], `evaluations` i32[], `final_cosine` f32[],
      `rotation_error` f32[] rad, `frobenius_angle` f32[] rad, `translation_error` f32[] m, `is_false_positive` bool[],
      `unreachable` i32[], and `best_scores` f32[G], G = the largest number of generations that the config allows.
    """
    rotation, frobenius, translation = pose_error(camera, target, env.scene.symmetry, env.center)
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
    }
