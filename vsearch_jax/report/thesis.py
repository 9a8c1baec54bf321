"""The thesis's published values, under the keys of `results.json`. A list is a range [low, high].

The thesis's means for random search and CMA-ES cover only the trials that met the threshold. Ours cover all trials.
"""

from __future__ import annotations

THESIS: dict[str, dict[str, float | list[float]]] = {
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


def thesis_range(searcher: str, key: str) -> tuple[float, float] | None:
    """Returns the thesis's published value of one measure as (lowest, highest). A single value is returned twice.

    Args:
      searcher: the searcher, for example "sac"; a key of `results.json`.
      key: the measure, for example "success_rate"; a key of `results.json`.

    Returns:
      The range, or None where the thesis gives no value.
    """
    value = THESIS.get(searcher, {}).get(key)
    if value is None:
        return None
    low, high = value if isinstance(value, list) else (value, value)
    return low, high
