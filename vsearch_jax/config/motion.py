"""Configuration of what moves the arm: inverse kinematics and planning."""

from __future__ import annotations

import math
from dataclasses import dataclass

from vsearch_jax.config.validation import require, require_positive


@dataclass(frozen=True)
class IKConfig:
    """Levenberg-Marquardt inverse kinematics and the reachability map that feeds it starts."""

    num_seeds: int = 16
    """Starts of `ik`: the present joints and others spread over the limits."""
    num_iterations: int = 16
    """Iterations from each start."""
    num_nullspace_steps: int = 6
    """Steps of `ik` along the redundancy, towards the present joints and away from the limits."""
    is_roll_free: bool = False
    """Whether the camera may turn about its optical axis."""
    damping: float = 1e-3
    """Initial damping of the normal equations."""
    position_tolerance: float = 1e-3
    """Converged below this error in m."""
    rotation_tolerance_deg: float = 0.1
    """Converged below this error in degrees."""
    map_azimuths: int = 72
    """Cells of the reachability map around the object."""
    map_elevations: int = 19
    """Cells of the reachability map from the table plane to the pole."""
    map_seeds: int = 24
    """Random starts for each cell of the map."""
    map_iterations: int = 40
    """Iterations from each start of the map."""

    def __post_init__(self) -> None:
        require_positive(
            self,
            "num_seeds",
            "num_iterations",
            "damping",
            "position_tolerance",
            "rotation_tolerance_deg",
            "map_azimuths",
            "map_seeds",
            "map_iterations",
        )
        require(self, "map_elevations", self.map_elevations >= 2, "2 or more")
        require(self, "num_nullspace_steps", self.num_nullspace_steps >= 0, "0 or more")

    @property
    def rotation_tolerance(self) -> float:
        """`rotation_tolerance_deg` in rad."""
        return math.radians(self.rotation_tolerance_deg)


@dataclass(frozen=True)
class PlanningConfig:
    """Collision-free joint paths and their timing."""

    num_nodes: int = 512
    """Nodes of a tree, at most."""
    max_iterations: int = 4096
    """Edges that are tried for one problem, at most."""
    step: float = 3.0
    """Length in rad of a tree's random edges."""
    resolution: float = 0.004
    """How near in m the arm may come before an edge that leads nearer is given up; see `planning.edge_is_free`."""
    num_shortcuts: int = 64
    """Attempts to shorten a path."""
    max_waypoints: int = 48
    """Configurations of a path, at most."""
    acceleration_time: float = 0.5
    """Seconds in which a joint can come to its full speed: what limits its acceleration."""
    settling_time: float = 0.6
    """Seconds that a dynamic arm is given at the end of a motion."""

    def __post_init__(self) -> None:
        require_positive(self, "num_nodes", "max_iterations", "step", "acceleration_time")
        require(self, "resolution", 1e-4 <= self.resolution <= 0.1, "from 0.0001 to 0.1 m")
        require(self, "settling_time", self.settling_time >= 0.0, "0 or more")
        require(self, "num_shortcuts", self.num_shortcuts >= 0, "0 or more")
        require(self, "max_waypoints", self.max_waypoints >= 3, "3 or more")
