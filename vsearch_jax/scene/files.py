"""The files of a scene's parts: found, read, and refused in one line."""

from __future__ import annotations

import logging
import os
from importlib import resources
from pathlib import Path

import mujoco
import numpy as np

from vsearch_jax.config import SceneConfig
from vsearch_jax.scene.meshes import MESH_SUFFIXES, MeshError, check, is_read_by_mujoco, read_mesh

TCP_SITE = "tcp"
WRIST_CAMERA = "wrist"

_LOG = logging.getLogger(__name__)


class SceneError(ValueError):
    """A scene cannot be built; the one-line message names the part, the file and the remedy."""


def xml_folder() -> Path:
    """Returns the folder of the MJCF files: inside the installed package, else beside it in a checkout."""
    packaged = Path(str(resources.files("vsearch_jax"))) / "xml"
    return packaged if packaged.is_dir() else Path(__file__).resolve().parents[2] / "xml"


def available(kind: str) -> tuple[str, ...]:
    """Returns the names of what comes with the package: `kind` is "arm", "objects" or "obstacles"."""
    return tuple(sorted(path.stem for path in (xml_folder() / kind).glob("*.xml")))


def find(part: str, name: str) -> Path:
    """Returns the file of "arm", "object" or "obstacles" `name`, one of the package's or a path.

    Raises:
      SceneError: there is none.
    """
    folder = "objects" if part == "object" else part
    path = Path(os.path.expanduser(name))  # which leaves the home of an unknown user as it is
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
        raise SceneError(f"{part} file {str(path)!r} cannot be loaded: {one_line(error)}") from error
    return spec


def load_arm(path: Path) -> mujoco.MjSpec:
    """Returns an arm that carries its own weight, loose parts standing still.

    Raises:
      SceneError: the file cannot be loaded, or lacks the site or the camera, or has a ball joint or a free one in its
        chain.
    """
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


def load_object(path: Path, config: SceneConfig) -> mujoco.MjSpec:
    """Returns an object without joints, from MJCF or a mesh.

    Raises:
      SceneError: the file cannot be loaded, or has nothing to look at.
    """
    if path.suffix.lower() in MESH_SUFFIXES:
        try:
            return _load_mesh(path, config)
        except (MeshError, ValueError) as error:
            raise SceneError(f"object file {str(path)!r} cannot be loaded: {one_line(error)}") from error
    spec = load_still("object", path)
    if not spec.geoms:
        raise SceneError(f"object file {str(path)!r} has no geom; there is nothing to look at")
    return spec


def load_still(part: str, path: Path) -> mujoco.MjSpec:
    """Returns an MJCF without its joints; `part` is what errors call it.

    Raises:
      SceneError: the file cannot be loaded.
    """
    spec = _load(part, path)
    for joint in list(spec.joints):
        spec.delete(joint)
    return spec


def _load_mesh(path: Path, config: SceneConfig) -> mujoco.MjSpec:
    spec = mujoco.MjSpec()
    # The object does not move, so a mesh with holes, which has no volume, is as good as another.
    mesh = spec.add_mesh(name="mesh", inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL)
    if is_read_by_mujoco(path):
        mesh.file = str(path)
    else:
        vertices, faces = read_mesh(path)
        mesh.uservert, mesh.userface = vertices.reshape(-1), faces.reshape(-1)
    mesh.scale = [config.mesh_scale] * 3
    geom = spec.worldbody.add_body(name="mesh").add_geom(
        name="mesh", type=mujoco.mjtGeom.mjGEOM_MESH, meshname="mesh", rgba=[0.75, 0.55, 0.35, 1.0]
    )
    model = spec.compile()
    # MuJoCo moved the vertices into the frame of the mesh's inertia; this is the way back to the file's frame.
    rotation = np.zeros(9)
    mujoco.mju_quat2Mat(rotation, model.mesh_quat[0])
    vertices = model.mesh_vert @ rotation.reshape(3, 3).T + model.mesh_pos[0]
    report = check(vertices, model.mesh_face, config.radius)
    if report.num_degenerate or report.num_open_edges:
        _LOG.warning("object file %r: %s", str(path), report)
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    if not config.is_mesh_recentred:
        return spec
    geom.pos = [-(low[0] + high[0]) / 2.0, -(low[1] + high[1]) / 2.0, -low[2]]
    return spec


def one_line(error: Exception) -> str:
    """Returns the message of `error` without its line breaks."""
    return " ".join(str(error).split())
