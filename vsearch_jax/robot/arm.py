"""Kinematics, joint limits and clearance of the arm in a scene."""

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
from vsearch_jax.robot.rest import rest_pose
from vsearch_jax.scene import Scene, SceneError


@flax.struct.dataclass
class Arm:
    """An arm in its scene: kinematics, joint limits, and the pairs of geoms that must not touch.

    Attributes:
      joints: all joints of the model.
      chain: the J joints between the world and the wrist camera. Each joint hangs on the joint before it.
      wrist: f32[4, 4], pose of the wrist camera in the frame of the last joint of `chain`.
      bodies: Placement of the bodies: to which joint frame each body is fixed, and where.
      geoms: Placement of the geoms.
      sites: Placement of the sites.
      cameras: Placement of the cameras.
      lower: f32[nq] rad or m, lower joint limits; -inf for a joint without limits.
      upper: f32[nq] rad or m, upper joint limits; +inf for a joint without limits.
      home: f32[nq] rad or m, rest pose: middle of the limits; `qpos0` for a joint without limits. A gripper with
        equality constraints rests where they hold.
      speed: f32[nq] rad/s or m/s, speed limits; NaN where the model gives none. The model gives a speed limit as the
        attribute `user` of a joint.
      pairs: pairs of geoms that must not touch.
      planning_pairs: the subset of `pairs` that planning checks. Ellipsoids around the arm are replaced by enclosing
        capsules.
      table_height: f32[] m, world z of the table.
      table_clearance: f32[] m, minimum distance of the arm from the table.
      data: mjx.Data, template that `forward_kinematics` fills.
      camera_id: MuJoCo's number of the wrist camera.
      joints_without_speed: names of the joints of `chain` that have no speed limit.
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
    """Signed distances in m between the arm's moving geoms and other geoms; +inf where there are no other geoms.

    Attributes:
      table: f32[], from the table.
      object: f32[], from the object.
      self: f32[], between links that are not neighbours, and from the mount.
      obstacles: f32[], from the obstacles.
    """

    table: Array
    object: Array
    self: Array
    obstacles: Array


def build_arm(scene: Scene) -> Arm:
    """Builds the arm of a scene: its kinematics, its joint limits, and the pairs of geoms that must not touch.

    Raises:
      SceneError: a joint that moves the wrist camera, or a slide, has no limits.
    """
    model, data = scene.mj_model, _data_at_qpos0(scene.mj_model)
    joints = kinematics.build_joints(model, data)
    cameras = kinematics.build_placement(model, data, "cam")
    lower, upper, speed = _joint_limits(scene)
    pairs, planning_pairs = _build_collision_pairs(scene, data)
    return Arm(
        joints=joints,
        chain=_camera_chain(joints, scene.joint_ids),
        wrist=_placement_matrix(cameras, scene.camera_id),
        bodies=kinematics.build_placement(model, data, "body"),
        geoms=kinematics.build_placement(model, data, "geom"),
        sites=kinematics.build_placement(model, data, "site"),
        cameras=cameras,
        lower=jnp.asarray(lower, jnp.float32),
        upper=jnp.asarray(upper, jnp.float32),
        home=jnp.asarray(rest_pose(model, lower, upper, scene.joint_ids), jnp.float32),
        speed=jnp.asarray(speed, jnp.float32),
        pairs=pairs,
        planning_pairs=planning_pairs,
        table_height=jnp.float32(scene.table_height),
        table_clearance=jnp.float32(scene.table_clearance),
        data=mjx.make_data(scene.mjx_model),
        camera_id=scene.camera_id,
        joints_without_speed=tuple(
            model.joint(j).name for j in scene.joint_ids if np.isnan(speed[model.jnt_qposadr[j]])
        ),
    )


def _data_at_qpos0(model: mujoco.MjModel) -> mujoco.MjData:
    """Returns MuJoCo's data with the kinematics at `qpos0`, cameras included."""
    data = mujoco.MjData(model)
    data.qpos[:] = model.qpos0
    mujoco.mj_kinematics(model, data)
    mujoco.mj_camlight(model, data)
    return data


def _camera_chain(joints: Joints, joint_ids: tuple[int, ...]) -> Joints:
    """Returns the joints `joint_ids` as a serial chain that starts at the world."""
    ids = np.asarray(joint_ids)
    chain = jax.tree.map(lambda leaf: leaf[ids], joints)
    return dataclasses.replace(chain, parent=jnp.arange(len(ids), dtype=jnp.int32))


def _placement_matrix(placement: Placement, index: int) -> Array:
    """Returns f32[4, 4], the pose of item `index` in its frame."""
    rotation = SO3.from_matrix(placement.rotation[index])
    return SE3.from_rotation_and_translation(rotation, placement.position[index]).as_matrix()


def _joint_limits(scene: Scene) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns lower limits, upper limits and speed limits, f64[nq] each; -inf, +inf and NaN where there are none."""
    model = scene.mj_model
    lower, upper, speed = (np.full(model.nq, value) for value in (-np.inf, np.inf, np.nan))
    for joint in range(model.njnt):
        address = model.jnt_qposadr[joint]
        if model.jnt_limited[joint]:
            lower[address], upper[address] = model.jnt_range[joint]
        # How far a finger's slide can move geoms bounds their distances, too.
        elif joint in scene.joint_ids or model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_SLIDE:
            raise SceneError(
                f"joint {model.joint(joint).name!r} has no limits, but planning needs them; "
                "give the joint a `range` in the arm's file"
            )
        if model.nuser_jnt and model.jnt_user[joint, 0] > 0:
            speed[address] = model.jnt_user[joint, 0]
    return lower, upper, speed


def _build_collision_pairs(scene: Scene, data: mujoco.MjData) -> tuple[collision.Pairs, collision.Pairs]:
    """Returns all pairs of geoms that must not touch, and the pairs that planning checks."""
    geoms = collision.Geoms(scene.arm_geom_ids, scene.mount_geom_ids, scene.object_geom_ids, scene.obstacle_geom_ids)
    return (
        collision.build_pairs(scene.mj_model, data, geoms, scene.joint_ids, is_for_planning=False),
        collision.build_pairs(scene.mj_model, data, geoms, scene.joint_ids, is_for_planning=True),
    )


def forward_kinematics(arm: Arm, qpos: Array) -> mjx.Data:
    """Computes the poses of all bodies, geoms, sites and cameras at one configuration.

    The poses equal those of C MuJoCo to 1e-5.

    Args:
      arm: the arm.
      qpos: f32[nq] rad or m, values of all joints.

    Returns:
      mjx.Data with these fields set: qpos, xpos, xmat, xanchor, xaxis, geom_xpos, geom_xmat, site_xpos, site_xmat,
      cam_xpos, cam_xmat. All other fields (velocities, quaternions, inertias) keep the values of `arm.data`.
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
    """Returns the pose of the wrist camera in world.

    Args:
      arm: the arm.
      data: kinematics of the arm, from `forward_kinematics`.

    Returns:
      T_world_camera, the transform from the camera's frame to world; translation in m.
    """
    return SE3.from_rotation_and_translation(
        SO3.from_matrix(data.cam_xmat[arm.camera_id]), data.cam_xpos[arm.camera_id]
    )


def camera_kinematics(arm: Arm, joint_values: Array) -> tuple[Array, Array, Array]:
    """Computes the pose of the wrist camera and its Jacobian. IK calls this function in each iteration.

    Args:
      arm: the arm.
      joint_values: f32[J] rad or m, values of the J joints that move the camera (`arm.chain`).

    Returns:
      Position of the camera, f32[3] m in world. Rotation of the camera, f32[3, 3], camera to world. Geometric Jacobian
      of the camera's pose, f32[6, J] in world: three linear rows (m), then three angular rows (rad) (Siciliano et al.,
      Robotics, 3.1.3).
    """
    rotations, positions, axes, anchors = kinematics.frames(arm.chain, joint_values)
    rotation = kinematics.matmul(rotations[-1], arm.wrist[:3, :3])
    position = positions[-1] + kinematics.rotate(rotations[-1], arm.wrist[:3, 3])
    is_slide = arm.chain.is_slide[:, None]
    linear = jnp.where(is_slide, axes, jnp.cross(axes, position[None] - anchors))
    angular = jnp.where(is_slide, 0.0, axes)
    return position, rotation, jnp.concatenate([linear, angular], axis=-1).T


def clearance(arm: Arm, data: mjx.Data) -> Clearance:
    """Computes how far the arm is from the table, the object, the obstacles and itself.

    Geoms have the shapes that MuJoCo collides: a mesh counts as its convex hull. Only an object's mesh and a height
    field count as their bounding boxes. The true distance is never smaller than the result. As in MuJoCo, pairs of
    neighbouring links and pairs that the model excludes are ignored, and those of `<contact><pair>` are added.

    Args:
      arm: the arm.
      data: kinematics of the arm, from `forward_kinematics`.

    Returns:
      Signed distances in m, the smallest for each of the four; negative in contact.
    """
    pairs = arm.pairs
    gap = collision.pair_distances(pairs, data.geom_xpos, data.geom_xmat, arm.table_height)
    return Clearance(
        table=collision.min_distance(pairs, gap, collision.TABLE),
        object=collision.min_distance(pairs, gap, collision.OBJECT),
        self=collision.min_distance(pairs, gap, collision.SELF),
        obstacles=collision.min_distance(pairs, gap, collision.OBSTACLE),
    )


def is_free(arm: Arm, data: mjx.Data) -> Array:
    """Checks that the arm touches nothing and keeps the minimum distance from the table.

    Args:
      arm: the arm.
      data: kinematics of the arm, from `forward_kinematics`.

    Returns:
      bool[], true if there is no contact and the distance from the table is above `arm.table_clearance`.
    """
    gap = collision.pair_distances(arm.pairs, data.geom_xpos, data.geom_xmat, arm.table_height)
    return jnp.all(gap > jnp.where(arm.pairs.part == collision.TABLE, arm.table_clearance, 0.0))
