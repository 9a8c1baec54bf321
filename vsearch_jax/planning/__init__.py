"""From a view to joints, and from joints to joints: inverse kinematics, the reachability map, paths."""

from vsearch_jax.planning.edges import edge_is_free
from vsearch_jax.planning.ik import ik
from vsearch_jax.planning.reachability import nearest_cell, reachability_map, solve_view
from vsearch_jax.planning.rrt import rrt, rrt_connect
from vsearch_jax.planning.starts import ik_from_starts, start_limits
from vsearch_jax.planning.trajectory import (
    Motion,
    PlanningError,
    Trajectory,
    check_speeds,
    duration,
    state_at,
    straight_duration,
    time_path,
)

__all__ = [
    "Motion",
    "PlanningError",
    "Trajectory",
    "check_speeds",
    "duration",
    "edge_is_free",
    "ik",
    "ik_from_starts",
    "nearest_cell",
    "reachability_map",
    "rrt",
    "rrt_connect",
    "solve_view",
    "start_limits",
    "state_at",
    "straight_duration",
    "time_path",
]
