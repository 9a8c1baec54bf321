"""Frames of a tree of hinges and slides, by one scan over the joints.

This fills the fields of `mjx.kinematics` from the model's own constants. It does not call that function: vmapped over
64 configurations of the LWR and compiled for CPU (jax 0.9.2, mjx 3.17) it takes 0.14 s of processor time for each, this
scan 2e-6 s. The likely reason: XLA fuses its unrolled chain of bodies and computes each body anew for every use of it.
"""

from __future__ import annotations

import functools

import flax.struct
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array

from vsearch_jax.xla.batching import append_axes


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


def matmul(a: Array, b: Array) -> Array:
    """Returns the product of `a` and `b` (f32[..., 3, 3]) as a sum: on CPU, XLA runs it faster than a batched dot."""
    return jnp.sum(a[..., :, :, None] * b[..., None, :, :], axis=-2)


def rotate(rotation: Array, vector: Array) -> Array:
    """Returns f32[..., 3], `vector` (f32[..., 3]) turned by `rotation` (f32[..., 3, 3]); both of the same rank."""
    return jnp.sum(rotation * vector[..., None, :], axis=-1)


def rotate_each(rotations: Array, vectors: Array) -> Array:
    """Returns f32[N, 3, ...], `vectors` (f32[N, 3, ...]) turned by `rotations` (f32[N, 3, 3, ...]); see `frames`."""
    return jnp.sum(rotations * vectors[:, None], axis=2)


def frames(joints: Joints, values: Array) -> tuple[Array, Array, Array, Array]:
    """Returns rotations f32[J + 1, 3, 3] and origins f32[J + 1, 3] of world and joints, axes and anchors f32[J, 3].

    All are in world; axes and anchors are MuJoCo's `xaxis` and `xanchor`.

    Args:
      joints: the J joints.
      values: f32[J] rad or m, of the joints; they may have a batch axis more at the end, then the results have it too.
    """
    count, wide = joints.parent.shape[0], functools.partial(append_axes, count=values.ndim - 1)
    axis, is_slide, rotation = wide(joints.axis), wide(joints.is_slide), wide(joints.rotation)
    change = values - wide(joints.reference)
    angle, offset = jnp.where(is_slide, 0.0, change), jnp.where(is_slide, change, 0.0)
    # In the frames of the parents, all at once; what is left for the scan is to chain them.
    shift = rotate_each(rotation, axis) * offset[:, None]
    turned = jnp.sum(rotation[:, :, :, None] * _axis_rotations(axis, angle)[:, None], axis=2)
    start = (
        jnp.broadcast_to(wide(jnp.eye(3)), (count + 1, *turned.shape[1:])),
        jnp.zeros((count + 1, *turned.shape[2:])),
    )
    steps = (joints.parent, turned, wide(joints.position) + shift, jnp.arange(1, count + 1))
    (rotations, positions), _ = jax.lax.scan(_next_frame, start, steps)
    axes = rotate_each(rotations[1:], axis)
    return rotations, positions, axes, positions[1:] - axes * offset[:, None]


def _next_frame(done: tuple[Array, Array], step: tuple[Array, Array, Array, Array]) -> tuple[tuple[Array, Array], None]:
    (rotations, positions), (parent, turned, position, index) = done, step
    outer = rotations[parent]
    rotation = jnp.sum(outer[:, :, None] * turned[None], axis=1)
    position = positions[parent] + jnp.sum(outer * position[None], axis=1)
    return (rotations.at[index].set(rotation), positions.at[index].set(position)), None


def _axis_rotations(axis: Array, angle: Array) -> Array:
    """Rodrigues' formula; f32[J, 3, 3, ...] from f32[J, 3, ...] and f32[J, ...]."""
    x, y, z = axis[:, 0], axis[:, 1], axis[:, 2]
    zero = jnp.zeros_like(x)
    cross = jnp.stack([jnp.stack(row, axis=1) for row in ((zero, -z, y), (z, zero, -x), (-y, x, zero))], axis=1)
    outer = axis[:, :, None] * axis[:, None, :]
    cosine, sine = jnp.cos(angle)[:, None, None], jnp.sin(angle)[:, None, None]
    return cosine * append_axes(jnp.eye(3)[None], angle.ndim - 1) + sine * cross + (1.0 - cosine) * outer


def place(things: Placement, rotations: Array, positions: Array) -> tuple[Array, Array]:
    """Returns positions f32[N, 3] m and rotations f32[N, 3, 3] in world, from those of the frames (see `frames`)."""
    rotation = rotations[things.frame]
    return positions[things.frame] + rotate(rotation, things.position), matmul(rotation, things.rotation)


def _body_frames(model: mujoco.MjModel) -> np.ndarray:
    """Returns i32[nbody]: the frame of the last joint that moves the body."""
    frame = np.zeros(model.nbody, dtype=np.int32)
    for body in range(1, model.nbody):
        first, count = model.body_jntadr[body], model.body_jntnum[body]
        frame[body] = first + count if count else frame[model.body_parentid[body]]
    return frame


def _frame_poses(model: mujoco.MjModel, data: mujoco.MjData) -> tuple[np.ndarray, np.ndarray]:
    rotations = np.concatenate([np.eye(3)[None], data.xmat.reshape(-1, 3, 3)[model.jnt_bodyid]])
    return rotations, np.concatenate([np.zeros((1, 3)), data.xanchor])


def build_joints(model: mujoco.MjModel, data: mujoco.MjData) -> Joints:
    """Returns the joints of `model`, all hinges or slides; `data` holds its kinematics at `qpos0`."""
    body_frame = _body_frames(model)
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


def build_placement(model: mujoco.MjModel, data: mujoco.MjData, kind: str) -> Placement:
    """Returns where things of a `kind` are fixed: "body", "geom", "site" or "cam"; `data` as for `build_joints`."""
    body_frame = _body_frames(model)
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
