"""Kinematics, limits and clearance of the arm in a scene."""

from __future__ import annotations

import dataclasses

import flax.struct
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array
from jaxlie import SE3, SO3
from mujoco import mjx

from vsearch_jax.robot import collision, kinematics
from vsearch_jax.robot.kinematics import Joints, Placement
from vsearch_jax.scene import Scene, SceneError


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
      speed: f32[nq] rad/s or m/s, speed limits; NaN where the model gives none (`user` of the joint).
      pairs: geometry that must not touch.
      planning_pairs: those of them that planning must look at.
      table_height: f32[] m, world z of the table.
      table_clearance: f32[] m, least distance from the table.
      data: mjx.Data into which `forward_kinematics` writes.
      camera_id: the wrist camera.
      joints_without_speed: names of the joints that move the camera and have no speed limit.
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
    speed: Array
    pairs: collision.Pairs
    planning_pairs: collision.Pairs
    table_height: Array
    table_clearance: Array
    data: mjx.Data
    camera_id: int = flax.struct.field(pytree_node=False)
    joints_without_speed: tuple[str, ...] = flax.struct.field(pytree_node=False)


@flax.struct.dataclass
class Clearance:
    """Signed distances in m of the arm's moving geoms from what they must not touch; +inf where there is nothing.

    Attributes:
      table: f32[], of the lowest point from the table.
      object: f32[], from the nearest geom of the object.
      self: f32[], between links that are not neighbours, and from the mount.
      obstacles: f32[], from whatever else stands around.
    """

    table: Array
    object: Array
    self: Array
    obstacles: Array


def build_arm(scene: Scene) -> Arm:
    """Returns the arm of `scene`.

    Raises:
      SceneError: a joint that moves the camera has no limits.
    """
    model = scene.mj_model
    data = mujoco.MjData(model)
    data.qpos[:] = model.qpos0
    mujoco.mj_kinematics(model, data)
    mujoco.mj_camlight(model, data)
    joints = kinematics.build_joints(model, data)
    cameras = kinematics.build_placement(model, data, "cam")
    ids = np.asarray(scene.joint_ids)
    chain = dataclasses.replace(
        jax.tree.map(lambda leaf: leaf[ids], joints), parent=jnp.arange(len(ids), dtype=jnp.int32)
    )
    lower, upper, speed = _limits(scene)
    is_limited, home = np.isfinite(lower), model.qpos0.copy()
    home[is_limited] = 0.5 * (lower[is_limited] + upper[is_limited])
    camera = scene.camera_id
    geoms = collision.Geoms(scene.arm_geom_ids, scene.mount_geom_ids, scene.object_geom_ids, scene.obstacle_geom_ids)
    return Arm(
        joints=joints,
        chain=chain,
        wrist=SE3.from_rotation_and_translation(
            SO3.from_matrix(cameras.rotation[camera]), cameras.position[camera]
        ).as_matrix(),
        bodies=kinematics.build_placement(model, data, "body"),
        geoms=kinematics.build_placement(model, data, "geom"),
        sites=kinematics.build_placement(model, data, "site"),
        cameras=cameras,
        lower=jnp.asarray(lower, jnp.float32),
        upper=jnp.asarray(upper, jnp.float32),
        home=jnp.asarray(home, jnp.float32),
        speed=jnp.asarray(speed, jnp.float32),
        pairs=collision.build_pairs(model, data, geoms, scene.joint_ids, is_for_planning=False),
        planning_pairs=collision.build_pairs(model, data, geoms, scene.joint_ids, is_for_planning=True),
        table_height=jnp.float32(scene.table_height),
        table_clearance=jnp.float32(scene.table_clearance),
        data=mjx.make_data(scene.mjx_model),
        camera_id=camera,
        joints_without_speed=tuple(
            model.joint(j).name for j in scene.joint_ids if np.isnan(speed[model.jnt_qposadr[j]])
        ),
    )


def _limits(scene: Scene) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns lower and upper limits and speed limits, f64[nq] each; infinite or NaN where there are none."""
    model = scene.mj_model
    lower, upper, speed = (np.full(model.nq, value) for value in (-np.inf, np.inf, np.nan))
    for joint in range(model.njnt):
        address = model.jnt_qposadr[joint]
        if model.jnt_limited[joint]:
            lower[address], upper[address] = model.jnt_range[joint]
        elif joint in scene.joint_ids:
            raise SceneError(
                f"joint {model.joint(joint).name!r} has no limits, so its values cannot be searched; give it a range"
            )
        if model.nuser_jnt and model.jnt_user[joint, 0] > 0:
            speed[address] = model.jnt_user[joint, 0]
    return lower, upper, speed


def forward_kinematics(arm: Arm, qpos: Array) -> mjx.Data:
    """Returns where everything is at `qpos` (f32[nq], rad or m).

    Filled are qpos, xpos, xmat, xanchor, xaxis, geom_xpos, geom_xmat, site_xpos, site_xmat, cam_xpos, cam_xmat; the
    rest of the data (velocities, quaternions, inertias) is not. Equal to C MuJoCo to 1e-5.
    """
    rotations, positions, axes, anchors = kinematics.frames(arm.joints, qpos[arm.joints.address])
    body_position, body_rotation = kinematics.place(arm.bodies, rotations, positions)
    geom_position, geom_rotation = kinematics.place(arm.geoms, rotations, positions)
    site_position, site_rotation = kinematics.place(arm.sites, rotations, positions)
    camera_position, camera_rotation = kinematics.place(arm.cameras, rotations, positions)
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
      f32[3] m in world; f32[3, 3] camera to world; the geometric Jacobian f32[6, J] in world, linear rows (m) before
      angular ones (rad) (Siciliano et al., Robotics, 3.1.3).
    """
    rotations, positions, axes, anchors = kinematics.frames(arm.chain, joint_values)
    rotation = kinematics.matmul(rotations[-1], arm.wrist[:3, :3])
    position = positions[-1] + kinematics.rotate(rotations[-1], arm.wrist[:3, 3])
    is_slide = arm.chain.is_slide[:, None]
    linear = jnp.where(is_slide, axes, jnp.cross(axes, position[None] - anchors))
    angular = jnp.where(is_slide, 0.0, axes)
    return position, rotation, jnp.concatenate([linear, angular], axis=-1).T


def clearance(arm: Arm, data: mjx.Data) -> Clearance:
    """Returns how far the arm is from table, object and itself, from the data of `forward_kinematics`.

    Geoms that are no capsules count as the capsule around them on the arm, and as the box around them where the object
    is a mesh; the distance is then on the safe side. Neighbours and excluded pairs are left out as MuJoCo does.
    """
    pairs = arm.pairs
    gap = collision.pair_distances(pairs, data.geom_xpos, data.geom_xmat, arm.table_height)
    parts = (collision.TABLE, collision.OBJECT, collision.SELF, collision.OBSTACLE)
    table, target, own, obstacles = (collision.min_distance(pairs, gap, part) for part in parts)
    return Clearance(table=table, object=target, self=own, obstacles=obstacles)


def is_free(arm: Arm, data: mjx.Data) -> Array:
    """Returns bool[]: nothing touches, and the table's clearance is kept."""
    gap = collision.pair_distances(arm.pairs, data.geom_xpos, data.geom_xmat, arm.table_height)
    return jnp.all(gap > jnp.where(arm.pairs.part == collision.TABLE, arm.table_clearance, 0.0))
