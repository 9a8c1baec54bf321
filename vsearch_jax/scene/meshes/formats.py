"""Facts about mesh formats: which can be read, which axis points up, and what a file holds that cannot be drawn."""

from __future__ import annotations

import json
import re
import zipfile
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from vsearch_jax.scene.meshes.checks import MeshError

MESH_SUFFIXES = (".obj", ".stl", ".ply", ".glb", ".gltf", ".dae", ".3mf", ".off", ".msh")
"""Suffixes of the mesh files that can be read, in lower case."""

FORMAT_NAMES = "OBJ, STL, PLY, GLB, GLTF, DAE, 3MF, OFF, MSH"
"""The formats of `MESH_SUFFIXES`, for messages."""

_COMPRESSIONS = {"KHR_draco_mesh_compression": "Draco", "EXT_meshopt_compression": "meshopt"}
_GLTF_LOSSES = {
    "KHR_texture_basisu": "textures in the format KTX2",
    "KHR_texture_transform": "transforms of textures",
}
# Mode of a glTF primitive. trimesh skips it.
_TRIANGLE_FAN = 6
_COLLADA_AXES = {"X_UP": "x", "Y_UP": "y", "Z_UP": "z"}
_3MF_COLOURS = (b"basematerials", b"colorgroup", b"texture2dgroup")


def up_axis(path: Path) -> str:
    """Returns the axis that points up in a mesh file, as its format defines it: "x", "y" or "z".

    It is +y in glTF and +z in 3MF. A COLLADA file (.dae) names its axis; the default is +y. The other formats define
    no axis; +z is taken.

    Args:
      path: an existing file with a suffix of `MESH_SUFFIXES`.

    Raises:
      MeshError: the file is not what its suffix says.
    """
    suffix = path.suffix.lower()
    if suffix in (".glb", ".gltf"):
        return "y"
    return _collada_axis(path) if suffix == ".dae" else "z"


def unsupported_content(path: Path) -> list[str]:
    """Lists what a mesh file holds that trimesh does not read, for a warning. Empty for most files.

    Args:
      path: an existing file with a suffix of `MESH_SUFFIXES`.

    Raises:
      MeshError: the triangles cannot be read, because they are compressed; or the file is not what its suffix says.
    """
    suffix = path.suffix.lower()
    if suffix in (".glb", ".gltf"):
        return _gltf_losses(path)
    if suffix == ".3mf":
        return _3mf_losses(path)
    return _obj_losses(path) if suffix == ".obj" else []


def _obj_losses(path: Path) -> list[str]:
    """Lists the materials of an OBJ file that trimesh does not find. It reads the first material library only."""
    content = path.read_bytes()
    libraries = _words_after(b"mtllib", content)
    if not libraries:
        return []
    library = path.parent / libraries[0]
    # A library that does not exist is reported where it is opened.
    defined = _words_after(b"newmtl", library.read_bytes()) if library.is_file() else []
    unknown = sorted(set(_words_after(b"usemtl", content)) - set(defined)) if defined else []
    losses = [f"the material library {name!r}, since only the first is read" for name in libraries[1:]]
    return losses + [f"the material {name!r}, which {libraries[0]!r} does not define" for name in unknown]


def _words_after(keyword: bytes, content: bytes) -> list[str]:
    """Returns the rests of the lines that begin with a keyword, without repetition."""
    found = re.findall(rb"^[ \t]*" + keyword + rb"[ \t]+([^\r\n]*)", content, re.MULTILINE)
    return list(dict.fromkeys(rest.decode("utf-8", "replace").strip() for rest in found))


def _collada_axis(path: Path) -> str:
    try:
        for _, element in ElementTree.iterparse(path):
            name = element.tag.rpartition("}")[2]
            if name == "up_axis":
                return _COLLADA_AXES.get((element.text or "").strip(), "y")
            if name == "asset":
                break
    except ElementTree.ParseError as error:
        raise MeshError(f"it is no COLLADA file ({error}); export it again") from error
    return "y"


def _gltf_losses(path: Path) -> list[str]:
    header = _gltf_header(path)
    used = header.get("extensionsUsed", [])
    for extension, name in _COMPRESSIONS.items():
        if extension in used:
            raise MeshError(f"its triangles are compressed ({name}); export it without mesh compression")
    losses = [words for extension, words in _GLTF_LOSSES.items() if extension in used]
    modes = {primitive.get("mode") for mesh in header.get("meshes", []) for primitive in mesh.get("primitives", [])}
    return [*losses, "triangle fans"] if _TRIANGLE_FAN in modes else losses


def _gltf_header(path: Path) -> dict[str, Any]:
    """Returns the JSON part of a glTF file, which is all of a .gltf and the first chunk of a .glb."""
    try:
        content = path.read_bytes()
        if content[:4] == b"glTF":
            content = content[20 : 20 + int.from_bytes(content[12:16], "little")]
        header = json.loads(content)
    except ValueError as error:
        raise MeshError(f"it is no glTF 2.0 file ({error}); export it again") from error
    if not isinstance(header, dict):
        raise MeshError("it is no glTF 2.0 file; export it again")
    return header


def _3mf_losses(path: Path) -> list[str]:
    try:
        with zipfile.ZipFile(path) as archive:
            models = [archive.read(name) for name in archive.namelist() if name.lower().endswith(".model")]
    except zipfile.BadZipFile as error:
        raise MeshError(f"it is no 3MF file ({error}); export it again") from error
    has_colours = any(word in model for model in models for word in _3MF_COLOURS)
    return ["colours in the format 3MF (export it as GLB to keep them)"] if has_colours else []
