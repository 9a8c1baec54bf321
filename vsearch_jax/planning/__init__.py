"""From a view to joints: inverse kinematics and the reachability map."""

from vsearch_jax.planning.ik import ik, ik_from_starts, start_limits
from vsearch_jax.planning.reachability import nearest_cell, reachability_map, solve_view

__all__ = ["ik", "ik_from_starts", "nearest_cell", "reachability_map", "solve_view", "start_limits"]
