"""Assembles the parts of a scene into one model."""

from __future__ import annotations

import copy
import logging
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
    find_file,
    load_arm,
    load_object,
    load_static,
    one_line,
    symmetry_of,
    xml_folder,
)
from vsearch_jax.scene.joint_chain import joints_above
from vsearch_jax.scene.meshes import MESH_SUFFIXES
from vsearch_jax.scene.surface import surface_points

ARM_PREFIX = "arm/"
OBJECT_PREFIX = "object/"
OBSTACLE_PREFIX = "obstacle/"
MAX_GROUP = 2
"""Geoms of higher groups are shapes for collisions, which no camera sees."""

_LOG = logging.getLogger(__name__)


@dataclass(frozen=True)
class Scene:
    """A built scene. In the model, names of the arm's elements start with `arm/`, of the object's with `object/`.

    All numbers of geoms, joints, sites and cameras are MuJoCo's.

    Attributes:
      mj_model: the compiled model for C MuJoCo.
      mjx_model: the model for MJX, with contacts disabled. Planning avoids contacts; `mj_model` is used to check them.
      center: f64[3] m in world, centre of the view sphere.
      radius: m, radius of the view sphere.
      table_height: m, world z of the table's surface.
      table_clearance: m, minimum distance of the arm from the table.
      joint_ids: joints between the world and the wrist camera, from the base outward.
      qpos_addresses: indices in qpos of the values of `joint_ids`.
      tcp_site_id: site at the tool centre point.
      camera_id: the wrist camera.
      arm_geom_ids: geoms of the arm, its fixed base included.
      mount_geom_ids: geoms of the mount.
      object_geom_ids: geoms of the object.
      obstacle_geom_ids: geoms of the obstacles.
      table_geom_id: the plane of the table.
      symmetry: number of turns about the vertical that map the object to itself; 1 for none, 0 for any turn.
      object_points: f64[P, 3] m in world, corners of the convex hull of the object's visible geoms.
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
    symmetry: int
    object_points: np.ndarray


def build_scene(config: SceneConfig) -> Scene:
    """Assembles table, lights, mount, arm, object and obstacles into one MuJoCo model.

    - The arm's base hangs from the mount. The +z axis of the base points down.
    - The object is fixed at the world's origin. The joints of the object's file are removed.
    - A mesh (OBJ, STL, PLY, GLB, GLTF, DAE, 3MF, OFF, MSH) is turned: its up axis (`mesh_up`) to +z. It is moved: its
      lowest point onto the table, the middle of its bounding box above the origin. `is_mesh_recentred=False` keeps the
      mesh where its file puts it. Each material is a geom. Holes, faces without area, and what cannot be drawn, are
      logged.

    Args:
      config: names or paths of arm, object and obstacles; mount height in m; view sphere.

    Raises:
      SceneError: one of these faults.
        - A name is unknown, or a file is missing or cannot be loaded.
        - The arm has no site `tcp`, no camera `wrist`, or no joint that moves the camera.
        - The arm has a ball joint, or a free joint that moves the camera. (Free joints of loose parts are removed.)
        - The camera is not fixed to its body, it is orthographic, or its sensor is not square and centred.
        - The object is of an unknown format, it has no geom, or its symmetry is no whole number.
        - The object is a mesh that is too large or too small.
        - A geom that the arm could touch is a plane.
    """
    arm_path, object_path = find_file("arm", config.arm), find_file("object", config.object)
    target = load_object(object_path, config)
    symmetry = symmetry_of(target, object_path) if config.symmetry is None else config.symmetry
    model = _compile_model(config, arm_path, object_path, target)
    _check_planes(model)
    camera_id = model.camera(ARM_PREFIX + WRIST_CAMERA).id
    _check_camera(model, camera_id, arm_path)
    _warn_without_contacts(model, arm_path)
    joint_ids = _camera_joints(model, camera_id, arm_path)
    mount_id = model.body("mount").id
    object_geom_ids = _geoms_below(model, model.body("object").id)
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
        object_geom_ids=object_geom_ids,
        obstacle_geom_ids=_geoms_below(model, model.body("obstacles").id),
        table_geom_id=model.geom("table").id,
        symmetry=symmetry,
        object_points=surface_points(model, [g for g in object_geom_ids if model.geom_group[g] <= MAX_GROUP]),
    )


def object_symmetry(config: SceneConfig) -> int:
    """Returns `Scene.symmetry` without building the scene, which takes long for a large mesh.

    Raises:
      SceneError: the object's file is missing or cannot be loaded, or its symmetry is no whole number.
    """
    if config.symmetry is not None:
        return config.symmetry
    path = find_file("object", config.object)
    return 1 if path.suffix.lower() in MESH_SUFFIXES else symmetry_of(load_static("object", path), path)


def _compile_model(config: SceneConfig, arm_path: Path, object_path: Path, target: mujoco.MjSpec) -> mujoco.MjModel:
    """Loads arm and obstacles, attaches all parts to the bodies of `scene.xml`, and compiles the model."""
    arm = load_arm(arm_path)
    spec = mujoco.MjSpec.from_file(str(xml_folder() / "scene.xml"))
    mount = spec.body("mount")
    mount.pos = [0.0, 0.0, config.mount_height]
    _attach(spec, arm, mount, ARM_PREFIX)
    _attach(spec, target, spec.body("object"), OBJECT_PREFIX)
    if config.obstacles is not None:
        obstacles = load_static("obstacles", find_file("obstacles", config.obstacles))
        _attach(spec, obstacles, spec.body("obstacles"), OBSTACLE_PREFIX)
    try:
        return spec.compile()
    except ValueError as error:
        raise SceneError(
            f"arm file {str(arm_path)!r} and object file {str(object_path)!r} cannot be combined into one model: "
            f"{one_line(error)}; correct the element that this message names"
        ) from error


def _attach(spec: mujoco.MjSpec, child: mujoco.MjSpec, body: mujoco.MjsBody, prefix: str) -> None:
    """Attaches `child` to `body`; the names of its elements get `prefix`."""
    # The physics options of the scene apply. MuJoCo would warn about every option that differs in the child.
    child.option = spec.option
    spec.attach(child, prefix=prefix, frame=body.add_frame())


def _check_planes(model: mujoco.MjModel) -> None:
    """Raises SceneError if the arm could touch a plane. Distances are computed for bounded solids only."""
    in_pair = {*model.pair_geom1.tolist(), *model.pair_geom2.tolist()}
    for geom in np.flatnonzero(model.geom_type == int(mujoco.mjtGeom.mjGEOM_PLANE)):
        can_touch = geom in in_pair or model.geom_contype[geom] | model.geom_conaffinity[geom]
        if can_touch and geom != model.geom("table").id:
            name = model.geom(geom).name
            raise SceneError(
                f"geom {name!r} (number {geom}) is a plane, but the arm can only keep its distance from bounded "
                "solids; make it a box, or set its contype and conaffinity to 0 if the arm need not avoid it"
            )


def _warn_without_contacts(model: mujoco.MjModel, path: Path) -> None:
    """Logs a warning if no moving geom of the arm can touch the scene. The object and obstacles are static."""
    is_moving = model.body_weldid[model.geom_bodyid] != 0
    if not np.any((model.geom_contype | model.geom_conaffinity)[is_moving]):
        _LOG.warning(
            "arm file %r: contype and conaffinity of all moving geoms are 0, so planning lets the arm pass through the "
            "table, the object and obstacles; give the geoms that collide contype and conaffinity 1",
            str(path),
        )


def _check_camera(model: mujoco.MjModel, camera_id: int, path: Path) -> None:
    """Raises SceneError if the wrist camera is not fixed to its body or its images are not square and centred."""
    if model.cam_mode[camera_id] != int(mujoco.mjtCamLight.mjCAMLIGHT_FIXED):
        mode = mujoco.mjtCamLight(int(model.cam_mode[camera_id])).name.removeprefix("mjCAMLIGHT_").lower()
        raise SceneError(
            f"arm file {str(path)!r}: camera {WRIST_CAMERA!r} has mode {mode!r}, but planning needs a camera that is "
            "fixed to its body; remove `mode` and `target`, and aim the camera by `pos` and `quat`"
        )
    is_perspective = model.cam_projection[camera_id] == mujoco.mjtProjection.mjPROJ_PERSPECTIVE
    focal, principal = model.cam_intrinsic[camera_id, :2], model.cam_intrinsic[camera_id, 2:]
    # Images are square. MuJoCo computes the field of view from the height of the sensor.
    width, height = model.cam_sensorsize[camera_id]
    is_square = height == 0.0 or (not principal.any() and np.isclose(width / focal[0], height / focal[1]))
    if not (is_perspective and is_square):
        raise SceneError(
            f"arm file {str(path)!r}: camera {WRIST_CAMERA!r} is orthographic or its sensor is not square and centred; "
            "replace its projection, sensorsize and principal by `fovy`"
        )


def _camera_joints(model: mujoco.MjModel, camera_id: int, path: Path) -> tuple[int, ...]:
    """Returns the joints that move the wrist camera, from the base outward."""
    joints = joints_above(model, int(model.cam_bodyid[camera_id]))
    if not joints:
        raise SceneError(
            f"arm file {str(path)!r} has no joint that moves the camera {WRIST_CAMERA!r}; "
            "put the camera on a body that a joint moves"
        )
    return tuple(joints)


def _geoms_below(model: mujoco.MjModel, root: int) -> tuple[int, ...]:
    """Returns the geoms of body `root` and of its descendants."""
    is_below = np.zeros(model.nbody, dtype=bool)
    is_below[root] = True
    for body in range(root + 1, model.nbody):  # MuJoCo numbers a parent before its children.
        is_below[body] |= is_below[model.body_parentid[body]]
    return tuple(np.flatnonzero(is_below[model.geom_bodyid]).tolist())


def _put_model(model: mujoco.MjModel) -> mjx.Model:
    """Returns the model for MJX with contacts disabled."""
    # MJX rejects a model with pairs of geom types that it cannot collide, unless contacts are disabled.
    without_contacts = copy.copy(model)
    without_contacts.geom_contype[:] = 0
    without_contacts.geom_conaffinity[:] = 0
    without_contacts.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    try:
        return mjx.put_model(without_contacts)
    except NotImplementedError as error:
        raise SceneError(
            f"MJX does not support a feature of the model: {one_line(error)}; remove it from the file of the arm, the "
            "object or the obstacles"
        ) from error
