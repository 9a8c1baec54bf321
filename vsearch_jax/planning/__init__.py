"""Inverse kinematics, the reachability map, collision-free joint paths, and their timing and execution."""

from vsearch_jax.planning.drive import check_drive
from vsearch_jax.planning.edges import edge_is_free
from vsearch_jax.planning.execution import Execution, execute, pass_through
from vsearch_jax.planning.ik import ik
from vsearch_jax.planning.mount_scan import Mount, best_mount, coverage, scan_mounts
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
    "Execution",
    "Motion",
    "Mount",
    "PlanningError",
    "Trajectory",
    "best_mount",
    "check_drive",
    "check_speeds",
    "coverage",
    "duration",
    "edge_is_free",
    "execute",
    "ik",
    "ik_from_starts",
    "nearest_cell",
    "pass_through",
    "reachability_map",
    "rrt",
    "rrt_connect",
    "scan_mounts",
    "solve_view",
    "start_limits",
    "state_at",
    "straight_duration",
    "time_path",
]
