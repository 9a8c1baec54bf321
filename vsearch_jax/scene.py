"""One MuJoCo model out of table, lights, mount, an arm that hangs from the mount, and an object to look at."""

from __future__ import annotations

import copy
import logging
from dataclasses import dataclass
from importlib import resources
from pathlib import Path

import mujoco
import numpy as np
from mujoco import mjx

from vsearch_jax.config import SceneConfig
from vsearch_jax.meshes import MESH_SUFFIXES, MeshError, check, is_read_by_mujoco, read_mesh

ARM_PREFIX = "arm/"
OBJECT_PREFIX = "object/"
OBSTACLE_PREFIX = "obstacle/"
TCP_SITE = "tcp"
WRIST_CAMERA = "wrist"

_LOG = logging.getLogger(__name__)


class SceneError(ValueError):
    """A scene cannot be built; the one-line message names the part, the file and the remedy."""


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


def xml_folder() -> Path:
    """Returns the folder of the MJCF files: inside the installed package, else beside it in a checkout."""
    packaged = Path(str(resources.files("vsearch_jax"))) / "xml"
    return packaged if packaged.is_dir() else Path(__file__).resolve().parent.parent / "xml"


def available(kind: str) -> tuple[str, ...]:
    """Returns the names of what comes with the package: `kind` is "arm", "objects" or "obstacles"."""
    return tuple(sorted(path.stem for path in (xml_folder() / kind).glob("*.xml")))


def build_scene(config: SceneConfig) -> Scene:
    """Assembles table, lights, mount, arm and object into one model.

    The arm's base hangs from the mount, its +z pointing down. The object stands fixed at the world's origin; joints of
    its file are dropped. A mesh (OBJ, STL, MSH, PLY, GLB and what else trimesh reads; in metres) is put with its lowest
    point on the table and the middle of its bounding box over the origin; holes and faces without area are logged.

    Args:
      config: names or paths of arm, object and obstacles, mount height and view sphere.

    Raises:
      SceneError: a name is unknown, a file is missing or cannot be loaded, the arm has no site `tcp`, no camera `wrist`
        or no joint that moves the camera, has a joint that is neither a hinge nor a slide (a loose part's free joint
        is dropped), the object has no geom, or it is a mesh too large or too small to be looked at.
    """
    arm_path, object_path = _find("arm", config.arm), _find("object", config.object)
    arm, target = _load_arm(arm_path), _load_object(object_path, config.radius)
    spec = mujoco.MjSpec.from_file(str(xml_folder() / "scene.xml"))
    mount = spec.body("mount")
    mount.pos = [0.0, 0.0, config.mount_height]
    _attach(spec, arm, mount, ARM_PREFIX)
    _attach(spec, target, spec.body("object"), OBJECT_PREFIX)
    if config.obstacles is not None:
        still = _load_still("obstacles", _find("obstacles", config.obstacles))
        _attach(spec, still, spec.body("obstacles"), OBSTACLE_PREFIX)
    try:
        model = spec.compile()
    except ValueError as error:
        raise SceneError(
            f"arm {str(arm_path)!r} and object {str(object_path)!r} do not fit into one model: {_one_line(error)}"
        ) from error
    camera_id = model.camera(ARM_PREFIX + WRIST_CAMERA).id
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


def _find(part: str, name: str) -> Path:
    folder = "objects" if part == "object" else part
    path = Path(name).expanduser()
    if path.suffix or path.parent != Path("."):
        if not path.is_file():
            raise SceneError(
                f"{part} file {name!r} does not exist; give a file or one of: {', '.join(available(folder))}"
            )
        return path.resolve()
    if name not in available(folder):
        raise SceneError(
            f"unknown {part} {name!r}; available: {', '.join(available(folder))}, or give the path of a file"
        )
    return xml_folder() / folder / f"{name}.xml"


def _load(part: str, path: Path) -> mujoco.MjSpec:
    """Loads an MJCF and compiles it alone, so that a fault is told of the file that has it."""
    try:
        spec = mujoco.MjSpec.from_file(str(path))
        spec.compile()
    except ValueError as error:
        raise SceneError(f"{part} file {str(path)!r} cannot be loaded: {_one_line(error)}") from error
    return spec


def _load_arm(path: Path) -> mujoco.MjSpec:
    spec = _load("arm", path)
    for kind, name, elements in (("site", TCP_SITE, spec.sites), ("camera", WRIST_CAMERA, spec.cameras)):
        if name not in [element.name for element in elements]:
            raise SceneError(
                f"arm file {str(path)!r} has no {kind} named {name!r}; add one to the body that holds the tool"
            )
    moving = _bodies_above(spec, spec.camera(WRIST_CAMERA).parent)
    for joint in list(spec.joints):
        if joint.type == mujoco.mjtJoint.mjJNT_FREE and joint.parent.id not in moving:
            spec.delete(joint)  # a loose part: below the mount MuJoCo allows none, so it stands where the file has it
        elif joint.type not in (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE):
            raise SceneError(
                f"arm file {str(path)!r}: joint {joint.name!r} is free or a ball; make it hinges or take it out"
            )
        else:
            joint.actgravcomp = True
    # As the controllers of real arms do, the actuators carry the arm's weight by themselves.
    for body in spec.bodies:
        body.gravcomp = 1.0
    return spec


def _bodies_above(spec: mujoco.MjSpec, body: mujoco.MjsBody) -> set[int]:
    """Returns the numbers of `body` and of those that it hangs on; `spec` has been compiled."""
    numbers = set()
    while body.id != spec.worldbody.id:
        numbers.add(body.id)
        body = body.parent
    return numbers


def _load_object(path: Path, largest: float) -> mujoco.MjSpec:
    if path.suffix.lower() in MESH_SUFFIXES:
        try:
            return _load_mesh(path, largest)
        except (MeshError, ValueError) as error:
            raise SceneError(f"object file {str(path)!r} cannot be loaded: {_one_line(error)}") from error
    spec = _load_still("object", path)
    if not spec.geoms:
        raise SceneError(f"object file {str(path)!r} has no geom; there is nothing to look at")
    return spec


def _load_still(part: str, path: Path) -> mujoco.MjSpec:
    spec = _load(part, path)
    for joint in list(spec.joints):
        spec.delete(joint)
    return spec


def _load_mesh(path: Path, largest: float) -> mujoco.MjSpec:
    spec = mujoco.MjSpec()
    # The object does not move, so a mesh with holes, which has no volume, is as good as another.
    mesh = spec.add_mesh(name="mesh", inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL)
    if is_read_by_mujoco(path):
        mesh.file = str(path)
    else:
        vertices, faces = read_mesh(path)
        mesh.uservert, mesh.userface = vertices.reshape(-1), faces.reshape(-1)
    geom = spec.worldbody.add_body(name="mesh").add_geom(
        name="mesh", type=mujoco.mjtGeom.mjGEOM_MESH, meshname="mesh", rgba=[0.75, 0.55, 0.35, 1.0]
    )
    model = spec.compile()
    # MuJoCo moved the vertices into the frame of the mesh's inertia; this is the way back to the file's frame.
    rotation = np.zeros(9)
    mujoco.mju_quat2Mat(rotation, model.mesh_quat[0])
    vertices = model.mesh_vert @ rotation.reshape(3, 3).T + model.mesh_pos[0]
    report = check(vertices, model.mesh_face, largest)
    if report.num_degenerate or report.num_open_edges:
        _LOG.warning("object file %r: %s", str(path), report)
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    geom.pos = [-(low[0] + high[0]) / 2.0, -(low[1] + high[1]) / 2.0, -low[2]]
    return spec


def _attach(spec: mujoco.MjSpec, child: mujoco.MjSpec, body: mujoco.MjsBody, prefix: str) -> None:
    # The scene's physics options hold; MuJoCo would warn of each that a file sets otherwise.
    child.option = spec.option
    spec.attach(child, prefix=prefix, frame=body.add_frame())


def _camera_joints(model: mujoco.MjModel, camera_id: int, path: Path) -> tuple[int, ...]:
    body, joints = int(model.cam_bodyid[camera_id]), []
    while body:
        first, count = int(model.body_jntadr[body]), int(model.body_jntnum[body])
        joints = [*range(first, first + count), *joints]
        body = int(model.body_parentid[body])
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
            f"the model uses what MJX does not support: {_one_line(error)}; take it out of the arm"
        ) from error


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())
