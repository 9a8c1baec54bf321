"""The parts of a scene put together into one model."""

from __future__ import annotations

import copy
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
from mujoco import mjx

from vsearch_jax.config import SceneConfig
from vsearch_jax.scene.files import (
    TCP_SITE,
    WRIST_CAMERA,
    SceneError,
    find,
    load_arm,
    load_object,
    load_still,
    one_line,
    xml_folder,
)
from vsearch_jax.scene.joint_chain import joints_above

ARM_PREFIX = "arm/"
OBJECT_PREFIX = "object/"
OBSTACLE_PREFIX = "obstacle/"


@dataclass(frozen=True)
class Scene:
    """A built scene. Names of the arm's elements begin with `arm/`, names of the object's with `object/`.

    Attributes:
      mj_model: the compiled model, for C MuJoCo.
      mjx_model: the same for MJX, without contacts: these are avoided by planning, and `mj_model` checks them.
      center: f64[3] m in world, the middle of the view sphere.
      radius: m, of the view sphere.
      table_height: m, world z of the table's surface.
      table_clearance: m, least distance of the arm from the table.
      joint_ids: joints between the world and the wrist camera, from the base outward.
      qpos_addresses: where the values of `joint_ids` lie in qpos.
      tcp_site_id: site at the tool centre point.
      camera_id: the wrist camera.
      arm_geom_ids: geoms of the arm, its fixed base included.
      mount_geom_ids: geoms of the mount.
      object_geom_ids: geoms of the object.
      obstacle_geom_ids: geoms of whatever else stands around.
      table_geom_id: the table plane.
    """

    mj_model: mujoco.MjModel
    mjx_model: mjx.Model
    center: np.ndarray
    radius: float
    table_height: float
    table_clearance: float
    joint_ids: tuple[int, ...]
    qpos_addresses: tuple[int, ...]
    tcp_site_id: int
    camera_id: int
    arm_geom_ids: tuple[int, ...]
    mount_geom_ids: tuple[int, ...]
    object_geom_ids: tuple[int, ...]
    obstacle_geom_ids: tuple[int, ...]
    table_geom_id: int


def build_scene(config: SceneConfig) -> Scene:
    """Assembles table, lights, mount, arm and object into one model.

    The arm's base hangs from the mount, its +z pointing down. The object stands fixed at the world's origin; joints of
    its file are dropped. A mesh (OBJ, STL, MSH, PLY, GLB and what else trimesh reads) is put with its lowest point on
    the table and the middle of its bounding box over the origin, unless the config wants it where its file has it;
    holes and faces without area are logged.

    Args:
      config: names or paths of arm, object and obstacles, mount height and view sphere.

    Raises:
      SceneError: a name is unknown, a file is missing or cannot be loaded, the arm has no site `tcp`, no camera `wrist`
        or no joint that moves the camera, has a joint that is neither a hinge nor a slide (a loose part's free joint
        is dropped), its camera does not see a square centrally, the object has no geom, or it is a mesh too large or
        too small to be looked at, or something that the arm could touch is a plane.
    """
    arm_path, object_path = find("arm", config.arm), find("object", config.object)
    arm, target = load_arm(arm_path), load_object(object_path, config)
    spec = mujoco.MjSpec.from_file(str(xml_folder() / "scene.xml"))
    mount = spec.body("mount")
    mount.pos = [0.0, 0.0, config.mount_height]
    _attach(spec, arm, mount, ARM_PREFIX)
    _attach(spec, target, spec.body("object"), OBJECT_PREFIX)
    if config.obstacles is not None:
        still = load_still("obstacles", find("obstacles", config.obstacles))
        _attach(spec, still, spec.body("obstacles"), OBSTACLE_PREFIX)
    try:
        model = spec.compile()
    except ValueError as error:
        raise SceneError(
            f"arm {str(arm_path)!r} and object {str(object_path)!r} do not fit into one model: {one_line(error)}"
        ) from error
    _check_planes(model)
    camera_id = model.camera(ARM_PREFIX + WRIST_CAMERA).id
    _check_camera(model, camera_id, arm_path)
    joint_ids = _camera_joints(model, camera_id, arm_path)
    mount_id, object_id = model.body("mount").id, model.body("object").id
    return Scene(
        mj_model=model,
        mjx_model=_put_model(model),
        center=np.array([0.0, 0.0, config.center_height]),
        radius=config.radius,
        table_height=float(model.geom("table").pos[2]),
        table_clearance=config.table_clearance,
        joint_ids=joint_ids,
        qpos_addresses=tuple(int(model.jnt_qposadr[j]) for j in joint_ids),
        tcp_site_id=model.site(ARM_PREFIX + TCP_SITE).id,
        camera_id=camera_id,
        arm_geom_ids=tuple(g for g in _geoms_below(model, mount_id) if model.geom_bodyid[g] != mount_id),
        mount_geom_ids=tuple(np.flatnonzero(model.geom_bodyid == mount_id).tolist()),
        object_geom_ids=_geoms_below(model, object_id),
        obstacle_geom_ids=_geoms_below(model, model.body("obstacles").id),
        table_geom_id=model.geom("table").id,
    )


def _attach(spec: mujoco.MjSpec, child: mujoco.MjSpec, body: mujoco.MjsBody, prefix: str) -> None:
    # The scene's physics options hold; MuJoCo would warn of each that a file sets otherwise.
    child.option = spec.option
    spec.attach(child, prefix=prefix, frame=body.add_frame())


def _check_planes(model: mujoco.MjModel) -> None:
    """Raises SceneError for a plane that the arm could touch: it has no extent, from which distances are known."""
    for geom in np.flatnonzero(model.geom_type == int(mujoco.mjtGeom.mjGEOM_PLANE)):
        if model.geom_contype[geom] | model.geom_conaffinity[geom] and geom != model.geom("table").id:
            name = model.geom(geom).name
            raise SceneError(
                f"geom {name!r} (number {geom}) is a plane, from which the arm cannot keep its distance; make it a "
                "box, or give it contype 0 and conaffinity 0 if it is only to be seen"
            )


def _check_camera(model: mujoco.MjModel, camera_id: int, path: Path) -> None:
    is_perspective = model.cam_projection[camera_id] == mujoco.mjtProjection.mjPROJ_PERSPECTIVE
    focal, principal = model.cam_intrinsic[camera_id, :2], model.cam_intrinsic[camera_id, 2:]
    # Square pictures are taken; MuJoCo derives the field of view from a sensor's height.
    width, height = model.cam_sensorsize[camera_id]
    is_plain = height == 0.0 or (not principal.any() and np.isclose(width / focal[0], height / focal[1]))
    if not (is_perspective and is_plain):
        raise SceneError(
            f"arm file {str(path)!r}: camera {WRIST_CAMERA!r} is orthographic or its sensor is not square and central; "
            "give it `fovy` in place of projection, sensorsize and principal"
        )


def _camera_joints(model: mujoco.MjModel, camera_id: int, path: Path) -> tuple[int, ...]:
    joints = joints_above(model, int(model.cam_bodyid[camera_id]))
    if not joints:
        raise SceneError(f"arm file {str(path)!r} has no joint that moves the camera {WRIST_CAMERA!r}")
    return tuple(joints)


def _geoms_below(model: mujoco.MjModel, root: int) -> tuple[int, ...]:
    """Returns the geoms of body `root` and of all bodies that hang on it."""
    is_below = np.zeros(model.nbody, dtype=bool)
    is_below[root] = True
    for body in range(root + 1, model.nbody):  # a parent comes before its children
        is_below[body] |= is_below[model.body_parentid[body]]
    return tuple(np.flatnonzero(is_below[model.geom_bodyid]).tolist())


def _put_model(model: mujoco.MjModel) -> mjx.Model:
    # MJX refuses a model whose solids it cannot collide with one another, unless none may collide.
    without_contacts = copy.copy(model)
    without_contacts.geom_contype[:] = 0
    without_contacts.geom_conaffinity[:] = 0
    without_contacts.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    try:
        return mjx.put_model(without_contacts)
    except NotImplementedError as error:
        raise SceneError(
            f"the model uses what MJX does not support: {one_line(error)}; take it out of the arm"
        ) from error
