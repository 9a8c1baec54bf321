"""Signed distances between the arm's capsules and what they must not touch."""

from vsearch_jax.robot.collision.distances import Axes, axes_from_frames, gaps, gaps_between, least
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
    "axes_from_frames",
    "build_pairs",
    "gaps",
    "gaps_between",
    "least",
]
