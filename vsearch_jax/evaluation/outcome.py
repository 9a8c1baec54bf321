"""What is measured of a search that has ended."""

from __future__ import annotations

import math
from typing import Any

from vsearch_jax.config import Config
from vsearch_jax.env import pose_error
from vsearch_jax.types import Camera, SearchResult

FALSE_POSITIVE_DEG = 10.0
"""A found view whose rotation is further than this from the target's is a false positive (thesis 3.6)."""


def measure_outcome(config: Config, result: SearchResult, camera: Camera, target: Camera) -> dict[str, Any]:
    """Returns the measures of a search that ended at `camera`, when `target` was looked for."""
    rotation, frobenius, translation = pose_error(camera, target)
    is_success = result.score >= config.env.threshold
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
