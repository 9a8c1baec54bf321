"""Finds, loads and checks the files of a scene's parts."""

from __future__ import annotations

import logging
import os
from importlib import resources
from pathlib import Path

import mujoco
import numpy as np

from vsearch_jax.config import SceneConfig
from vsearch_jax.scene.meshes import MESH_SUFFIXES, MeshError, check_mesh, is_read_by_mujoco, read_mesh

TCP_SITE = "tcp"
WRIST_CAMERA = "wrist"

_LOG = logging.getLogger(__name__)


class SceneError(ValueError):
    """A scene cannot be built. The message has one line; it names the part, the file and the remedy."""


def xml_folder() -> Path:
    """Returns the folder of the package's own MJCF files, in the installed package or in a checkout."""
    packaged = Path(str(resources.files("vsearch_jax"))) / "xml"
    return packaged if packaged.is_dir() else Path(__file__).resolve().parents[2] / "xml"


def available(kind: str) -> tuple[str, ...]:
    """Returns the names of the arms, objects or obstacles that the package brings, for options and error messages.

    Args:
      kind: "arm", "objects" or "obstacles".
    """
    return tuple(sorted(path.stem for path in (xml_folder() / kind).glob("*.xml")))


def find_file(part: str, name: str) -> Path:
    """Returns the path of the file of an arm, an object or obstacles.

    Args:
      part: "arm", "object" or "obstacles".
      name: name of one of the package's own files, or a path. A name with a suffix or a folder is a path.

    Returns:
      The path of an existing file.

    Raises:
      SceneError: the name is unknown, or the file does not exist.
    """
    folder = "objects" if part == "object" else part
    path = Path(os.path.expanduser(name))  # Path.expanduser raises an exception for an unknown user; this does not.
    if path.suffix or path.parent != Path("."):
        if not path.is_file():
            raise SceneError(
                f"SceneConfig.{part} is {name!r}, a file that does not exist; "
                f"give the path of a file, or one of these names: {', '.join(available(folder))}"
            )
        return path.resolve()
    if name not in available(folder):
        raise SceneError(
            f"SceneConfig.{part} is {name!r}; available: {', '.join(available(folder))}; "
            "give one of these names, or the path of a file"
        )
    return xml_folder() / folder / f"{name}.xml"


def _load_mjcf(part: str, path: Path) -> mujoco.MjSpec:
    """Loads an MJCF file. Compiles it alone, so that an error message names the faulty file."""
    try:
        spec = mujoco.MjSpec.from_file(str(path))
        spec.compile()
    except ValueError as error:
        raise SceneError(f"{part} file {str(path)!r} cannot be loaded: {one_line(error)}; correct it") from error
    return spec


def load_arm(path: Path) -> mujoco.MjSpec:
    """Loads an arm from an MJCF file, and prepares it to be attached to the scene.

    The actuators get gravity compensation. The free joints of loose parts are removed.

    Raises:
      SceneError: the file cannot be loaded, it has no site `tcp` or no camera `wrist`, a joint is a ball, or a free
        joint moves the camera.
    """
    spec = _load_mjcf("arm", path)
    for kind, name, elements in (("site", TCP_SITE, spec.sites), ("camera", WRIST_CAMERA, spec.cameras)):
        if name not in [element.name for element in elements]:
            raise SceneError(
                f"arm file {str(path)!r} has no {kind} named {name!r}; add one to the body that holds the tool"
            )
    camera_bodies = _bodies_above(spec, spec.camera(WRIST_CAMERA).parent)
    for joint in list(spec.joints):
        if joint.type == mujoco.mjtJoint.mjJNT_FREE and joint.parent.id not in camera_bodies:
            spec.delete(joint)  # MuJoCo allows no free joint below the mount, so the loose part becomes fixed.
        elif joint.type not in (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE):
            raise SceneError(
                f"arm file {str(path)!r}: joint {joint.name!r} is a free joint or a ball joint; "
                "replace it by hinges or slides, or remove it"
            )
        else:
            joint.actgravcomp = True
    # The actuators compensate gravity, as the controllers of real arms do.
    for body in spec.bodies:
        body.gravcomp = 1.0
    return spec


def _bodies_above(spec: mujoco.MjSpec, body: mujoco.MjsBody) -> set[int]:
    """Returns the numbers of `body` and its ancestors, the world excluded. `spec` must be compiled."""
    numbers = set()
    while body.id != spec.worldbody.id:
        numbers.add(body.id)
        body = body.parent
    return numbers


def load_object(path: Path, config: SceneConfig) -> mujoco.MjSpec:
    """Loads an object from an MJCF or mesh file and removes its joints, so that it does not move.

    Args:
      path: an MJCF or mesh file.
      config: scale and placement of a mesh; radius in m of the view sphere, which is the maximum size of a mesh.

    Returns:
      The object, without joints.

    Raises:
      SceneError: the file cannot be loaded, it has no geom, or it is a mesh that is too large or too small.
    """
    if path.suffix.lower() in MESH_SUFFIXES:
        try:
            return _load_mesh(path, config)
        except MeshError as error:
            raise SceneError(f"object file {str(path)!r} cannot be loaded: {one_line(error)}") from error
        except ValueError as error:  # MuJoCo's message names no remedy.
            raise SceneError(
                f"object file {str(path)!r} cannot be loaded: {one_line(error)}; export it again"
            ) from error
    spec = load_static("object", path)
    if not spec.geoms:
        raise SceneError(f"object file {str(path)!r} has no geom, so no camera can see it; add a geom")
    return spec


def symmetry_of(spec: mujoco.MjSpec, path: Path) -> int:
    """Returns the symmetry that an object's MJCF declares: `<custom><numeric name="symmetry" data="4"/></custom>`.

    It is the number of turns about the vertical through the centre of the view sphere that map the object to itself.

    Args:
      spec: the object.
      path: the object's file, for the error message.

    Returns:
      1 if nothing is declared; 0 for any turn, as for a bowl.

    Raises:
      SceneError: the number is negative or not whole.
    """
    values = [numeric.data for numeric in spec.numerics if numeric.name == "symmetry"]
    if not values:
        return 1
    if len(values[0]) != 1 or values[0][0] < 0 or values[0][0] != int(values[0][0]):
        raise SceneError(
            f"object file {str(path)!r}: numeric 'symmetry' is {list(values[0])}; give one whole number: 1 for no "
            "symmetry, n for n equal turns about the vertical, 0 for any turn"
        )
    return int(values[0][0])


def load_static(part: str, path: Path) -> mujoco.MjSpec:
    """Loads an object or obstacles from an MJCF file and removes all joints, so that nothing in it moves.

    Args:
      part: word for error messages: "object" or "obstacles".
      path: path of the MJCF file.

    Returns:
      The content of the file, without joints.

    Raises:
      SceneError: the file cannot be loaded.
    """
    spec = _load_mjcf(part, path)
    for joint in list(spec.joints):
        spec.delete(joint)
    return spec


def _load_mesh(path: Path, config: SceneConfig) -> mujoco.MjSpec:
    """Loads a mesh file as one geom, checks it, and moves it onto the table if the config says so."""
    spec = mujoco.MjSpec()
    # The object does not move, so its inertia has no effect. The inertia of a shell exists for meshes with holes, too.
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
    vertices = _vertices_in_file_frame(model)
    report = check_mesh(vertices, model.mesh_face, config.radius)
    if report.num_degenerate or report.num_open_edges:
        _LOG.warning("object file %r: %s", str(path), report)
    if config.is_mesh_recentred:
        low, high = vertices.min(axis=0), vertices.max(axis=0)
        geom.pos = [-(low[0] + high[0]) / 2.0, -(low[1] + high[1]) / 2.0, -low[2]]
    return spec


def _vertices_in_file_frame(model: mujoco.MjModel) -> np.ndarray:
    """Returns f64[V, 3] m, the scaled vertices of the model's first mesh in the frame of its file."""
    # MuJoCo moved the vertices into the frame of the mesh's inertia.
    rotation = np.zeros(9)
    mujoco.mju_quat2Mat(rotation, model.mesh_quat[0])
    return model.mesh_vert @ rotation.reshape(3, 3).T + model.mesh_pos[0]


def one_line(error: Exception) -> str:
    """Returns the message of `error` without line breaks."""
    return " ".join(str(error).split())
