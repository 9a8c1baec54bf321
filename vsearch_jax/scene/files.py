"""Finds, loads and checks the files of a scene's parts."""

from __future__ import annotations

import os
from importlib import resources
from pathlib import Path

import mujoco

from vsearch_jax.config import SceneConfig
from vsearch_jax.scene.meshes import FORMAT_NAMES, MESH_SUFFIXES, MeshError, load_mesh

TCP_SITE = "tcp"
WRIST_CAMERA = "wrist"
# Models that MuJoCo reads.
_MODEL_SUFFIXES = (".xml", ".urdf", ".mjz")


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
    if path.suffix.lower() not in _MODEL_SUFFIXES:
        meshes = (
            f", or a mesh as {FORMAT_NAMES} (CAD programs export STEP and IGES as STL or GLB, Blender exports FBX and "
            "USD as GLB)"
        )
        raise SceneError(
            f"{part} file {str(path)!r}: the format {path.suffix!r} cannot be read; give MJCF (.xml)"
            f"{meshes if part == 'object' else ', in which geoms may name mesh files'}"
        )
    try:
        spec = mujoco.MjSpec.from_file(str(path))
        spec.compile()
    except ValueError as error:
        raise SceneError(f"{part} file {str(path)!r} cannot be loaded: {one_line(error)}; correct it") from error
    if spec.flexes:
        raise SceneError(
            f"{part} file {str(path)!r}: flex {spec.flexes[0].name!r} cannot be drawn or simulated; replace it by a "
            "mesh geom, or remove it from this file"
        )
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
      config: scale, up axis and placement of a mesh. The radius in m of the view sphere is its maximum size.

    Returns:
      The object, without joints.

    Raises:
      SceneError: the file cannot be loaded, its format is unknown, it has no geom, or it is a mesh that is too large
        or too small.
    """
    if path.suffix.lower() in MESH_SUFFIXES:
        try:
            return load_mesh(path, config)
        except MeshError as error:
            raise SceneError(f"object file {str(path)!r} cannot be loaded: {one_line(error)}") from error
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


def one_line(error: Exception) -> str:
    """Returns the message of `error` without line breaks."""
    return " ".join(str(error).split())
