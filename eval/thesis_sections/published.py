"""What the thesis published in chapter 5 and does not stand in `vsearch_jax.report.thesis`."""

from __future__ import annotations

TABLE_5_1 = {
    0.5: (0.702, 84.0, 28.0),
    1.5: (0.987, 3.0, 1.6),
    2.5: (0.983, 3.7, 2.0),
    4.5: (0.982, 4.6, 2.6),
}
"""Random search. {k: mean final cosine, mean rotational error in degrees, mean translational error in cm}."""

TABLE_5_2 = (
    (0.2, 130.0, 44.0, 0.06),
    (0.1, 140.0, 46.0, 0.02),
    (0.45, 170.0, 53.0, 0.42),
)
"""CMA-ES with the penalty. Of each trial: initial cosine, initial rotational error in degrees, initial translational
error in cm, final cosine."""

FAILED_RUNS = {"random_search": (1, 2, 5, 7, 9, 10), "cma_es": (2, 3, 5, 7, 9)}
"""Runs (1 to 10) of 12 trials in which one trial did not meet the threshold (sections 5.1 and 5.2)."""
