"""Signed distances between the arm's capsules and what they must not touch."""

from vsearch_jax.robot.collision.distances import Axes, capsule_axes, distances_from_axes, min_distance, pair_distances
from vsearch_jax.robot.collision.pairs import (
    NEVER_NEAR,
    OBJECT,
    OBSTACLE,
    SELF,
    TABLE,
    Geoms,
    Pairs,
    Solids,
    build_pairs,
)

__all__ = [
    "NEVER_NEAR",
    "OBJECT",
    "OBSTACLE",
    "SELF",
    "TABLE",
    "Axes",
    "Geoms",
    "Pairs",
    "Solids",
    "build_pairs",
    "capsule_axes",
    "distances_from_axes",
    "min_distance",
    "pair_distances",
]
