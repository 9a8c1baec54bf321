"""The arm in its scene: kinematics, limits, clearance."""
