"""Kinematics, limits and clearance of the arm in a scene.

The forward kinematics gives the fields of `mjx.kinematics` from the model's own constants. It does not call that function:
on a chain as long as an arm's, XLA on CPU fuses its unrolled bodies into one expression and computes each body again for
every use of it, down to the base (seen: 4 configurations a second; this scan over the joints: above 1,000,000).
"""

from __future__ import annotations

import flax.struct
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array
from jaxlie import SE3, SO3
from mujoco import mjx

from vsearch_jax import collision
from vsearch_jax.scene import Scene, SceneError


@flax.struct.dataclass
class Joints:
    """Hinges and slides in the order of their parents; the frame of a joint has its origin on the axis.

    Attributes:
      parent: i32[J], frame that the joint hangs on: 0 is the world, j + 1 the frame of joint j.
      position: f32[J, 3] m, origin in the parent's frame where the joint is at its reference.
      rotation: f32[J, 3, 3], of the frame against the parent's there.
      axis: f32[J, 3], unit vector in the frame.
      is_slide: bool[J].
      reference: f32[J] rad or m, value at which the model was drawn.
      address: i32[J], place in qpos.
    """

    parent: Array
    position: Array
    rotation: Array
    axis: Array
    is_slide: Array
    reference: Array
    address: Array


@flax.struct.dataclass
class Placement:
    """Things fixed to frames (bodies, geoms, sites or cameras).

    Attributes:
      frame: i32[N], as in `Joints.parent`.
      position: f32[N, 3] m in the frame.
      rotation: f32[N, 3, 3] to the frame.
    """

    frame: Array
    position: Array
    rotation: Array


@flax.struct.dataclass
class Arm:
    """An arm in its scene.

    Attributes:
      joints: every joint of the model.
      chain: the J joints between the world and the wrist camera, each hanging on the one before.
      wrist: f32[4, 4], pose of the wrist camera in the frame of the last joint of `chain`.
      bodies: Placement of the bodies.
      geoms: Placement of the geoms.
      sites: Placement of the sites.
      cameras: Placement of the cameras.
      lower: f32[nq] rad or m, lower limits; -inf without one.
      upper: f32[nq] rad or m, upper limits; +inf without one.
      home: f32[nq] rad or m, middle of the limits.
      pairs: geometry that must not touch.
      table_height: f32[] m, world z of the table.
      table_clearance: f32[] m, least distance from the table.
      data: mjx.Data into which `forward_kinematics` writes.
      camera_id: the wrist camera.
    """

    joints: Joints
    chain: Joints
    wrist: Array
    bodies: Placement
    geoms: Placement
    sites: Placement
    cameras: Placement
    lower: Array
    upper: Array
    home: Array
    pairs: collision.Pairs
    table_height: Array
    table_clearance: Array
    data: mjx.Data
    camera_id: int = flax.struct.field(pytree_node=False)


@flax.struct.dataclass
class Clearance:
    """Signed distances in m of the arm's moving geoms from what they must not touch; +inf where there is nothing.

    Attributes:
      table: f32[], of the lowest point from the table.
      object: f32[], from the nearest geom of the object.
      self: f32[], between links that are not neighbours, and from the mount.
    """

    table: Array
    object: Array
    self: Array


def build_arm(scene: Scene) -> Arm:
    """Returns the arm of `scene`.

    Raises:
      SceneError: a joint of the arm is neither a hinge nor a slide.
    """
    model = scene.mj_model
    free = np.isin(model.jnt_type, (int(mujoco.mjtJoint.mjJNT_FREE), int(mujoco.mjtJoint.mjJNT_BALL)))
    if free.any():
        name = model.joint(int(np.flatnonzero(free)[0])).name
        raise SceneError(f"joint {name!r} is neither a hinge nor a slide; fix it or take it out of the model")
    data = mujoco.MjData(model)
    data.qpos[:] = model.qpos0
    mujoco.mj_kinematics(model, data)
    mujoco.mj_camlight(model, data)
    body_frame = _body_frames(model)
    joints = _joints(model, data, body_frame)
    cameras = _placement(model, data, body_frame, "cam")
    ids = np.asarray(scene.joint_ids)
    chain = jax.tree.map(lambda leaf: leaf[ids], joints).replace(parent=jnp.arange(len(ids), dtype=jnp.int32))
    is_limited = model.jnt_limited.astype(bool)
    lower = np.where(is_limited, model.jnt_range[:, 0], -np.inf)
    upper = np.where(is_limited, model.jnt_range[:, 1], np.inf)
    camera = scene.camera_id
    return Arm(
        joints=joints,
        chain=chain,
        wrist=SE3.from_rotation_and_translation(
            SO3.from_matrix(cameras.rotation[camera]), cameras.position[camera]
        ).as_matrix(),
        bodies=_placement(model, data, body_frame, "body"),
        geoms=_placement(model, data, body_frame, "geom"),
        sites=_placement(model, data, body_frame, "site"),
        cameras=cameras,
        lower=jnp.asarray(lower, jnp.float32),
        upper=jnp.asarray(upper, jnp.float32),
        home=jnp.asarray(np.where(is_limited, model.jnt_range.mean(axis=1), 0.0), jnp.float32),
        pairs=collision.build_pairs(model, scene.arm_geom_ids, scene.mount_geom_ids, scene.object_geom_ids),
        table_height=jnp.float32(scene.table_height),
        table_clearance=jnp.float32(scene.table_clearance),
        data=mjx.make_data(scene.mjx_model),
        camera_id=camera,
    )


def forward_kinematics(arm: Arm, qpos: Array) -> mjx.Data:
    """Returns where everything is at `qpos` (f32[nq], rad or m).

    Filled are qpos, xpos, xmat, xanchor, xaxis, geom_xpos, geom_xmat, site_xpos, site_xmat, cam_xpos, cam_xmat; the
    rest of the data (velocities, quaternions, inertias) is not. Equal to C MuJoCo to 1e-5.
    """
    rotations, positions, axes, anchors = _frames(arm.joints, qpos)
    body_position, body_rotation = _place(arm.bodies, rotations, positions)
    geom_position, geom_rotation = _place(arm.geoms, rotations, positions)
    site_position, site_rotation = _place(arm.sites, rotations, positions)
    camera_position, camera_rotation = _place(arm.cameras, rotations, positions)
    return arm.data.replace(
        qpos=qpos,
        xpos=body_position,
        xmat=body_rotation,
        xanchor=anchors,
        xaxis=axes,
        geom_xpos=geom_position,
        geom_xmat=geom_rotation,
        site_xpos=site_position,
        site_xmat=site_rotation,
        cam_xpos=camera_position,
        cam_xmat=camera_rotation,
    )


def camera_pose(arm: Arm, data: mjx.Data) -> SE3:
    """Returns `T_world_camera` of the wrist camera from the data of `forward_kinematics`."""
    return SE3.from_rotation_and_translation(
        SO3.from_matrix(data.cam_xmat[arm.camera_id]), data.cam_xpos[arm.camera_id]
    )


def camera_kinematics(arm: Arm, joint_values: Array) -> tuple[Array, Array, Array]:
    """Returns position, rotation and Jacobian of the wrist camera; the part of the kinematics that IK repeats.

    Args:
      arm: the arm.
      joint_values: f32[J] rad or m, of the joints of `arm.chain`.

    Returns:
      f32[3] m in world; f32[3, 3] camera to world; the geometric Jacobian f32[6, J], linear rows (m) before angular ones
      (rad), in world (Siciliano et al., Robotics, 3.1.3).
    """
    chain = arm.chain.replace(address=jnp.arange(joint_values.shape[0], dtype=jnp.int32))
    rotations, positions, axes, anchors = _frames(chain, joint_values)
    rotation = _matmul(rotations[-1], arm.wrist[:3, :3])
    position = positions[-1] + _rotate(rotations[-1], arm.wrist[:3, 3])
    is_slide = arm.chain.is_slide[:, None]
    linear = jnp.where(is_slide, axes, jnp.cross(axes, position[None] - anchors))
    angular = jnp.where(is_slide, 0.0, axes)
    return position, rotation, jnp.concatenate([linear, angular], axis=-1).T


def clearance(arm: Arm, data: mjx.Data) -> Clearance:
    """Returns how far the arm is from table, object and itself, from the data of `forward_kinematics`.

    Geoms that are no capsules count as the capsule around them on the arm, and as the box around them where the object
    is a mesh; the distance is then on the safe side. Neighbours and excluded pairs are left out as MuJoCo does.
    """
    table, target, own = collision.distances(arm.pairs, data.geom_xpos, data.geom_xmat, arm.table_height)
    return Clearance(table=table, object=target, self=own)


def is_free(arm: Arm, data: mjx.Data) -> Array:
    """Returns bool[]: nothing touches, and the table's clearance is kept."""
    distance = clearance(arm, data)
    return (distance.table >= arm.table_clearance) & (distance.object > 0.0) & (distance.self > 0.0)


def _matmul(a: Array, b: Array) -> Array:
    # XLA on CPU runs a small batched product faster as a fused sum than as a dot.
    return jnp.sum(a[..., :, :, None] * b[..., None, :, :], axis=-2)


def _rotate(rotation: Array, vector: Array) -> Array:
    return jnp.sum(rotation * vector[..., None, :], axis=-1)


def _frames(joints: Joints, qpos: Array) -> tuple[Array, Array, Array, Array]:
    """Returns rotations f32[J + 1, 3, 3] and origins f32[J + 1, 3] of world and joints, axes and anchors f32[J, 3]."""
    count = joints.parent.shape[0]
    start = (jnp.tile(jnp.eye(3), (count + 1, 1, 1)), jnp.zeros((count + 1, 3)))
    values = qpos[joints.address] - joints.reference
    (rotations, positions), (axes, anchors) = jax.lax.scan(
        _next_frame, start, (joints, values, jnp.arange(1, count + 1))
    )
    return rotations, positions, axes, anchors


def _next_frame(
    frames: tuple[Array, Array], step: tuple[Joints, Array, Array]
) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    (rotations, positions), (joint, value, index) = frames, step
    parent = rotations[joint.parent]
    anchor = positions[joint.parent] + _rotate(parent, joint.position)
    rotation = _matmul(parent, joint.rotation)
    axis = _rotate(rotation, joint.axis)
    angle, offset = jnp.where(joint.is_slide, 0.0, value), jnp.where(joint.is_slide, value, 0.0)
    rotation = _matmul(rotation, _axis_rotation(joint.axis, angle))
    frames = (rotations.at[index].set(rotation), positions.at[index].set(anchor + axis * offset))
    return frames, (axis, anchor)


def _axis_rotation(axis: Array, angle: Array) -> Array:
    """Rodrigues' formula."""
    x, y, z = axis
    zero = jnp.zeros_like(x)
    cross = jnp.array([[zero, -z, y], [z, zero, -x], [-y, x, zero]])
    outer = axis[:, None] * axis[None, :]
    cosine, sine = jnp.cos(angle), jnp.sin(angle)
    return cosine * jnp.eye(3) + sine * cross + (1.0 - cosine) * outer


def _place(things: Placement, rotations: Array, positions: Array) -> tuple[Array, Array]:
    rotation = rotations[things.frame]
    return positions[things.frame] + _rotate(rotation, things.position), _matmul(rotation, things.rotation)


def _body_frames(model: mujoco.MjModel) -> np.ndarray:
    """Returns i32[nbody]: the frame of the last joint that moves the body."""
    frames = np.zeros(model.nbody, dtype=np.int32)
    for body in range(1, model.nbody):
        first, count = model.body_jntadr[body], model.body_jntnum[body]
        frames[body] = first + count if count else frames[model.body_parentid[body]]
    return frames


def _frame_poses(model: mujoco.MjModel, data: mujoco.MjData) -> tuple[np.ndarray, np.ndarray]:
    rotations = np.concatenate([np.eye(3)[None], data.xmat.reshape(-1, 3, 3)[model.jnt_bodyid]])
    return rotations, np.concatenate([np.zeros((1, 3)), data.xanchor])


def _joints(model: mujoco.MjModel, data: mujoco.MjData, body_frame: np.ndarray) -> Joints:
    rotations, positions = _frame_poses(model, data)
    is_first = np.arange(model.njnt) == model.body_jntadr[model.jnt_bodyid]
    above = body_frame[model.body_parentid[model.jnt_bodyid]]
    parent = np.where(is_first, above, np.arange(model.njnt)).astype(np.int32)
    inverse = np.swapaxes(rotations[parent], -1, -2)
    offset = positions[1:] - positions[parent]
    return Joints(
        parent=jnp.asarray(parent),
        position=jnp.asarray((inverse @ offset[..., None])[..., 0], jnp.float32),
        rotation=jnp.asarray(inverse @ rotations[1:], jnp.float32),
        axis=jnp.asarray(model.jnt_axis, jnp.float32),
        is_slide=jnp.asarray(model.jnt_type == int(mujoco.mjtJoint.mjJNT_SLIDE)),
        reference=jnp.asarray(model.qpos0[model.jnt_qposadr], jnp.float32),
        address=jnp.asarray(model.jnt_qposadr, jnp.int32),
    )


def _placement(model: mujoco.MjModel, data: mujoco.MjData, body_frame: np.ndarray, kind: str) -> Placement:
    if kind == "body":
        frame, position, rotation = body_frame, data.xpos, data.xmat
    else:
        frame = body_frame[getattr(model, f"{kind}_bodyid")]
        position, rotation = getattr(data, f"{kind}_xpos"), getattr(data, f"{kind}_xmat")
    rotations, positions = _frame_poses(model, data)
    inverse = np.swapaxes(rotations[frame], -1, -2)
    return Placement(
        frame=jnp.asarray(frame, jnp.int32),
        position=jnp.asarray((inverse @ (position - positions[frame])[..., None])[..., 0], jnp.float32),
        rotation=jnp.asarray(inverse @ rotation.reshape(-1, 3, 3), jnp.float32),
    )
