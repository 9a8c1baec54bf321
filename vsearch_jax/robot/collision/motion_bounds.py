"""Bounds on how far the joints can move a geom: what makes a step between two configurations safe to take unseen."""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np

from vsearch_jax.scene import joints_above

HINGE = int(mujoco.mjtJoint.mjJNT_HINGE)
SLIDE = int(mujoco.mjtJoint.mjJNT_SLIDE)


def lever_arms(model: mujoco.MjModel, data: mujoco.MjData, joints: tuple[int, ...]) -> np.ndarray:
    """Returns f64[ngeom, J]: most metres that any point of a geom moves for a unit (rad or m) of each of the `joints`.

    It is 0 for a joint that does not move the geom, 1 for a slide. For a hinge it is the farthest that the geom gets
    from the axis, bounded by the triangle inequality over the anchors of the joints between.

    Args:
      model: the model, of hinges and slides in the branches that `joints` move.
      data: its kinematics at `qpos0`.
      joints: numbers of the joints.
    """
    levers = np.zeros((model.ngeom, len(joints)))
    column = {joint: i for i, joint in enumerate(joints)}
    for geom in range(model.ngeom):
        chain = joints_above(model, int(model.geom_bodyid[geom]))
        for i, joint in enumerate(chain):
            if joint in column:
                is_slide = model.jnt_type[joint] == SLIDE
                levers[geom, column[joint]] = 1.0 if is_slide else _reach(model, data, geom, chain[i:])
    return levers


def extent_from_still_point(model: mujoco.MjModel, data: mujoco.MjData, geom: int) -> tuple[np.ndarray, float]:
    """Returns a point f64[3] m in world that no joint moves, and the farthest in m that any of `geom` gets from it."""
    chain = joints_above(model, int(model.geom_bodyid[geom]))
    while len(chain) > 1 and model.jnt_type[chain[0]] == HINGE:
        if _from_axis(data, chain[0], data.xanchor[chain[1]]) > 1e-9:
            break
        chain = chain[1:]  # the next anchor lies on the axis, so it stays where it is
    return data.xanchor[chain[0]], _travel(model, data, chain[:1]) + _spread(model, data, geom, chain)


def _reach(model: mujoco.MjModel, data: mujoco.MjData, geom: int, chain: Sequence[int]) -> float:
    """Returns the farthest in m that any point of `geom` gets from the axis of the first joint of `chain`."""
    if len(chain) == 1:
        points, radius = _hull(model, data, geom)
        return max(_from_axis(data, chain[0], point) for point in points) + radius
    return (
        _from_axis(data, chain[0], data.xanchor[chain[1]])
        + _spread(model, data, geom, chain[1:])
        + _travel(model, data, chain[1:2])
    )


def _spread(model: mujoco.MjModel, data: mujoco.MjData, geom: int, chain: Sequence[int]) -> float:
    """Returns the farthest in m that any point of `geom` gets from the anchor of the first joint of `chain`."""
    anchors = data.xanchor[list(chain)]
    between = float(np.linalg.norm(np.diff(anchors, axis=0), axis=1).sum())
    points, radius = _hull(model, data, geom)
    tip = max(float(np.linalg.norm(point - anchors[-1])) for point in points) + radius
    return between + tip + _travel(model, data, chain[1:])


def _travel(model: mujoco.MjModel, data: mujoco.MjData, joints: Sequence[int]) -> float:
    """Returns how far in m the slides among `joints` shift what hangs on them, against `qpos0`."""
    reference = model.qpos0[model.jnt_qposadr[list(joints)]]
    shift = np.abs(model.jnt_range[list(joints)] - reference[:, None]).max(axis=1)
    return float(shift[model.jnt_type[list(joints)] == SLIDE].sum())


def _from_axis(data: mujoco.MjData, joint: int, point: np.ndarray) -> float:
    return float(np.linalg.norm(np.cross(data.xaxis[joint], point - data.xanchor[joint])))


def _hull(model: mujoco.MjModel, data: mujoco.MjData, geom: int) -> tuple[list[np.ndarray], float]:
    """Returns points in world and the radius of balls around them whose hull holds `geom`."""
    center = data.geom_xpos[geom]
    if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_CAPSULE:
        half_axis = data.geom_xmat[geom].reshape(3, 3)[:, 2] * model.geom_size[geom, 1]
        return [center - half_axis, center + half_axis], float(model.geom_size[geom, 0])
    return [center], float(model.geom_rbound[geom])
