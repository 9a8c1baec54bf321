"""The thesis's own figures, under the names of `results.json`; [low, high] where it gives a range.

Its means for random search and CMA-ES are over the trials that met the threshold; ours are over all trials.
"""

from __future__ import annotations

from typing import Any

THESIS: dict[str, dict[str, Any]] = {
    # Sections 5.1 and 5.3: 10 runs of 12 initial views, k = 1.5.
    "random_search": {
        "success_rate": 0.95,
        "episodes": 120,
        "evaluations_mean": [40, 60],
        "final_cosine_mean": [0.985, 0.99],
        "rotation_error_deg_mean": [4, 5],
        "translation_error_cm_mean": [1, 2],
    },
    # Sections 5.2 and 5.3: 115 of 120 trials.
    "cma_es": {
        "success_rate": 0.96,
        "episodes": 120,
        "evaluations_mean": [40, 60],
        "final_cosine_mean": [0.985, 0.99],
        "rotation_error_deg_mean": [4, 5],
        "translation_error_cm_mean": [1, 2],
    },
    # Section 5.5: one target, 100 episodes.
    "sac": {
        "success_rate": 1.0,
        "episodes": 100,
        "evaluations_mean": 4,
        "final_cosine_mean": 0.99,
        "rotation_error_deg_mean": 3,
        "translation_error_cm_mean": 1.3,
        "environment_steps": 11_000,
    },
}
