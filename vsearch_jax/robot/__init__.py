"""The arm in its scene: kinematics, joint limits, clearance from obstacles."""

from vsearch_jax.robot.arm import (
    Arm,
    Clearance,
    build_arm,
    camera_kinematics,
    camera_pose,
    clearance,
    forward_kinematics,
    is_free,
)

__all__ = [
    "Arm",
    "Clearance",
    "build_arm",
    "camera_kinematics",
    "camera_pose",
    "clearance",
    "forward_kinematics",
    "is_free",
]
