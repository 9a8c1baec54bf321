"""Signed distances between the arm's capsules and the geoms that they must not touch."""

from vsearch_jax.robot.collision.candidates import NEVER_NEAR, Geoms
from vsearch_jax.robot.collision.distances import Axes, capsule_axes, distances_from_axes, min_distance, pair_distances
from vsearch_jax.robot.collision.pairs import OBJECT, OBSTACLE, SELF, TABLE, Pairs, Solids, build_pairs

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
