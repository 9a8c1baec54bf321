"""Signed distances between the arm's geoms and the geoms that they must not touch."""

from vsearch_jax.robot.collision.candidates import NEVER_NEAR, Geoms
from vsearch_jax.robot.collision.convex import Frames
from vsearch_jax.robot.collision.distances import (
    Axes,
    body_frames,
    capsule_axes,
    distances_from_poses,
    min_distance,
    pair_distances,
)
from vsearch_jax.robot.collision.pairs import OBJECT, OBSTACLE, SELF, TABLE, Pairs, Solids, build_pairs

__all__ = [
    "NEVER_NEAR",
    "OBJECT",
    "OBSTACLE",
    "SELF",
    "TABLE",
    "Axes",
    "Frames",
    "Geoms",
    "Pairs",
    "Solids",
    "body_frames",
    "build_pairs",
    "capsule_axes",
    "distances_from_poses",
    "min_distance",
    "pair_distances",
]
