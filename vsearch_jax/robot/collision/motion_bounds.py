"""Upper bounds on how far the joints can move a geom.

Planning uses them to prove that nothing touches between two configurations.
"""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np

from vsearch_jax.scene import box_corners, joints_above

HINGE = int(mujoco.mjtJoint.mjJNT_HINGE)
SLIDE = int(mujoco.mjtJoint.mjJNT_SLIDE)
# m. A point this near to an axis counts as a point on the axis.
ON_AXIS = 1e-9


def lever_arms(model: mujoco.MjModel, data: mujoco.MjData, joints: tuple[int, ...]) -> np.ndarray:
    """Computes an upper bound of how far one unit (rad or m) of each joint can move each geom.

    This bound is the lever arm of the joint. It is 0 for a joint that does not move the geom, and 1 for a slide. For a
    hinge it is the maximum distance of the geom from the axis over all configurations. That distance is bounded by the
    triangle inequality over the anchors of the joints between the hinge and the geom.

    Args:
      model: the model. The bodies that `joints` move have only hinges and slides.
      data: MuJoCo's data of the model, with the kinematics computed at `qpos0`.
      joints: MuJoCo's numbers of the J joints.

    Returns:
      Lever arms f64[ngeom, J], motion in m of any point of the geom for each unit (rad or m) of the joint.
    """
    levers = np.zeros((model.ngeom, len(joints)))
    column = {joint: i for i, joint in enumerate(joints)}
    for geom in range(model.ngeom):
        chain = joints_above(model, int(model.geom_bodyid[geom]))
        for i, joint in enumerate(chain):
            if joint in column:
                is_slide = model.jnt_type[joint] == SLIDE
                levers[geom, column[joint]] = 1.0 if is_slide else _max_axis_distance(model, data, geom, chain[i:])
    return levers


def extent_from_still_point(model: mujoco.MjModel, data: mujoco.MjData, geom: int) -> tuple[np.ndarray, float]:
    """Finds a ball that contains a geom in every configuration.

    Args:
      model: the model. The geom is moved by one joint or more, all hinges or slides.
      data: MuJoCo's data of the model, with the kinematics computed at `qpos0`.
      geom: MuJoCo's number of the geom.

    Returns:
      The ball's centre, f64[3] m in world, a point that no joint moves. The ball's radius in m.
    """
    chain = joints_above(model, int(model.geom_bodyid[geom]))
    first = _num_joints_before_still_point(model, data, chain)
    chain = chain[first:]
    return data.xanchor[chain[0]], _max_slide(model, chain[:1]) + _max_anchor_distance(model, data, geom, chain)


def _num_joints_before_still_point(model: mujoco.MjModel, data: mujoco.MjData, chain: Sequence[int]) -> int:
    """Returns the largest number of joints at the start of `chain` that do not move the anchor of the next joint.

    A point does not move if it lies on the axes of all hinges before it. The axis of the last one alone is not enough:
    the hinges before it move this axis.
    """
    found = 0
    for count in range(1, len(chain)):
        if model.jnt_type[chain[count - 1]] != HINGE:
            break
        anchor = data.xanchor[chain[count]]
        if max(_axis_distance(data, joint, anchor) for joint in chain[:count]) <= ON_AXIS:
            found = count
    return found


def _max_axis_distance(model: mujoco.MjModel, data: mujoco.MjData, geom: int, chain: Sequence[int]) -> float:
    """Returns an upper bound in m of the distance of any point of `geom` from the axis of the first joint."""
    if len(chain) == 1:
        points, radius = _enclosing_balls(model, data, geom)
        return max(_axis_distance(data, chain[0], point) for point in points) + radius
    return (
        _axis_distance(data, chain[0], data.xanchor[chain[1]])
        + _max_anchor_distance(model, data, geom, chain[1:])
        + _max_slide(model, chain[1:2])
    )


def _max_anchor_distance(model: mujoco.MjModel, data: mujoco.MjData, geom: int, chain: Sequence[int]) -> float:
    """Returns an upper bound in m of the distance of any point of `geom` from the anchor of the first joint."""
    anchors = data.xanchor[list(chain)]
    between_anchors = float(np.linalg.norm(np.diff(anchors, axis=0), axis=1).sum())
    points, radius = _enclosing_balls(model, data, geom)
    from_last_anchor = max(float(np.linalg.norm(point - anchors[-1])) for point in points) + radius
    return between_anchors + from_last_anchor + _max_slide(model, chain[1:])


def _max_slide(model: mujoco.MjModel, joints: Sequence[int]) -> float:
    """Returns the maximum sum in m of the displacements of the slides among `joints`, relative to `qpos0`."""
    reference = model.qpos0[model.jnt_qposadr[list(joints)]]
    shift = np.abs(model.jnt_range[list(joints)] - reference[:, None]).max(axis=1)
    return float(shift[model.jnt_type[list(joints)] == SLIDE].sum())


def _axis_distance(data: mujoco.MjData, joint: int, point: np.ndarray) -> float:
    """Returns the distance in m of `point` (f64[3] m in world) from the axis of `joint`."""
    return float(np.linalg.norm(np.cross(data.xaxis[joint], point - data.xanchor[joint])))


def _enclosing_balls(model: mujoco.MjModel, data: mujoco.MjData, geom: int) -> tuple[np.ndarray, float]:
    """Returns centres f64[K, 3] m in world and the common radius in m of balls whose convex hull contains `geom`.

    The balls of a sphere and of a capsule have its radius. For another geom they are the corners of its bounding box.
    """
    kind, rotation = int(model.geom_type[geom]), data.geom_xmat[geom].reshape(3, 3)
    if kind in (mujoco.mjtGeom.mjGEOM_SPHERE, mujoco.mjtGeom.mjGEOM_CAPSULE):
        half_length = float(model.geom_size[geom, 1]) if kind == mujoco.mjtGeom.mjGEOM_CAPSULE else 0.0
        return data.geom_xpos[geom] + np.outer([-half_length, half_length], rotation[:, 2]), model.geom_size[geom, 0]
    return data.geom_xpos[geom] + box_corners(model, geom) @ rotation.T, 0.0
