"""Configuration of the arm's motion: inverse kinematics and planning."""

from __future__ import annotations

import math
from dataclasses import dataclass

from vsearch_jax.config.validation import require, require_positive


@dataclass(frozen=True)
class IKConfig:
    """Inverse kinematics by Levenberg-Marquardt, and the reachability map that supplies start configurations."""

    num_seeds: int = 16
    """Number of start configurations of `ik`: the present joints, and others spread over the joint limits."""
    num_iterations: int = 16
    """Number of iterations from each start."""
    num_nullspace_steps: int = 6
    """Number of steps along the arm's redundancy. They lead towards the present joints and away from the limits."""
    is_roll_free: bool = False
    """Whether the camera may turn about its optical axis."""
    damping: float = 1e-3
    """Initial damping of the normal equations."""
    position_tolerance: float = 1e-3
    """Largest position error of a solution, in m."""
    rotation_tolerance_deg: float = 0.1
    """Largest rotation error of a solution, in degrees."""
    map_azimuths: int = 72
    """Number of cells of the reachability map around the object."""
    map_elevations: int = 19
    """Number of cells of the reachability map from the table plane to the pole."""
    map_seeds: int = 24
    """Number of random start configurations for each cell of the map."""
    map_iterations: int = 40
    """Number of iterations from each start of the map."""

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
        """Largest rotation error of an IK solution, in rad. The field `rotation_tolerance_deg` gives it in degrees."""
        return math.radians(self.rotation_tolerance_deg)


@dataclass(frozen=True)
class PlanningConfig:
    """Collision-free joint paths and their timing."""

    num_nodes: int = 512
    """Maximum number of nodes in a tree."""
    max_iterations: int = 4096
    """Maximum number of edges that are tried for one problem."""
    step: float = 3.0
    """Length of a tree's random edges, in rad."""
    resolution: float = 0.004
    """Smallest gap to an obstacle, in m. An edge that leads closer is rejected. See `planning.edge_is_free`."""
    num_shortcuts: int = 64
    """Number of attempts to shorten a path."""
    num_goals: int = 3
    """Number of IK solutions of a view to which a path is searched. The next is tried if no path leads to the last."""
    max_waypoints: int = 48
    """Maximum number of configurations in a path."""
    acceleration_time: float = 0.5
    """Time in which a joint reaches its full speed, in s. It limits the joint's acceleration."""
    settling_time: float = 0.6
    """Time at the end of a motion in which a dynamic arm comes to rest, in s."""

    def __post_init__(self) -> None:
        require_positive(self, "num_nodes", "max_iterations", "num_goals", "step", "acceleration_time")
        require(self, "resolution", 1e-4 <= self.resolution <= 0.1, "from 0.0001 to 0.1 m")
        require(self, "settling_time", self.settling_time >= 0.0, "0 or more")
        require(self, "num_shortcuts", self.num_shortcuts >= 0, "0 or more")
        require(self, "max_waypoints", self.max_waypoints >= 3, "3 or more")
