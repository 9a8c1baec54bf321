"""Fingerprints of the files from which a scene is built, to notice that a file was edited after the training.

A part (arm, object, obstacles) is unchanged if all its files are, byte for byte. A part in MJCF is also unchanged if
its compiled model is, as far as a run depends on it. So comments, and speed limits that are added later, do not count.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import urllib.parse
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TypeAlias, TypedDict

import mujoco
import numpy as np

from vsearch_jax.config import EnvConfig, SceneConfig
from vsearch_jax.scene.files import SceneError, find_file, one_line, xml_folder
from vsearch_jax.scene.meshes import MESH_SUFFIXES


class PartFingerprint(TypedDict):
    """Fingerprint of one part. JSON can store it.

    Attributes:
      files: for each file of the part its SHA-256. Names are relative to the folder of the part's own file.
      model: SHA-256 of the compiled model; None for a mesh file.
    """

    files: dict[str, str]
    model: str | None


Fingerprint: TypeAlias = dict[str, PartFingerprint]
"""For each part ("arm", "object", "obstacles") its fingerprint."""

_FIELDS = "qpos0 body_ jnt_ geom_ site_ cam_ light_ mesh_ hfield_ tex_ mat_ pair_ exclude_ eq_ key_qpos numeric_"
_DYNAMIC_FIELDS = f"{_FIELDS} actuator_ dof_ key_ tendon_ wrap_"
"""Beginnings of the names of the fields of MjModel on which a run depends, without and with dynamic motion."""
_SPEEDS = re.compile(r"jnt_user|.*pathadr")
_DYNAMICS = re.compile(
    r".*pathadr|.*poscom0|jnt_(user|stiffness|act|margin|sol).*|body_(mass|subtreemass|.*inertia|ipos|iquat|invweight0|gravcomp|sameframe|"
    r"simple|dof.*|user)|geom_(friction|sol.*|priority|condim|fluid|user|sameframe)|eq_sol.*|pair_(sol.*|friction)"
)
"""Fields that do not count: speed limits always, masses and forces without dynamic motion."""

_UNKNOWN = "unknown"
"""Hash of a file whose place is not known. MuJoCo names wrong paths for height fields."""
_NAMED_FILES = {
    ".obj": rb"^\s*mtllib\s+(.+?)\s*$",
    ".mtl": rb"^\s*(?:map_\w+|bump|disp|decal|refl|norm)\s+(.+?)\s*$",
    ".gltf": rb'"uri"\s*:\s*"([^"]+)"',
    ".dae": rb"<init_from>\s*(?:<ref>)?\s*([^<]+?)\s*<",
    ".ply": rb"^comment TextureFile (.+?)\s*$",
}
"""How a mesh or material file names the other files that it needs, by its suffix."""


def scene_fingerprint(scene: SceneConfig, env: EnvConfig) -> Fingerprint:
    """Computes the fingerprint of arm, object and obstacles.

    Args:
      scene: names or paths of the parts.
      env: the task. With dynamic motion, masses and actuators count too.

    Raises:
      SceneError: a file does not exist, or is no MJCF.
    """
    names = {"arm": scene.arm, "object": scene.object, "obstacles": scene.obstacles}
    is_dynamic = env.motion == "dynamic"
    return {part: _fingerprint(part, name, is_dynamic) for part, name in names.items() if name is not None}


def check_unchanged(scene: SceneConfig, env: EnvConfig, stored: Mapping[str, PartFingerprint]) -> None:
    """Checks that the files of a scene are those of the training.

    Args:
      scene: names or paths of the parts.
      env: the task.
      stored: the fingerprint at the start of the training. A part that it lacks is not checked.

    Raises:
      SceneError: a file has changed, does not exist, or is no MJCF.
    """
    for part, now in scene_fingerprint(scene, env).items():
        before = stored.get(part, now)
        changed = _changed_files(now["files"], before["files"])
        if not changed or (now["model"] is not None and now["model"] == before["model"]):
            continue
        path = find_file(part, getattr(scene, part))
        remedy = "restore the files as they were"
        if xml_folder() in path.parents:
            remedy = "install the version of vsearch_jax with which it was trained"
        raise SceneError(
            f"{part} file {str(path)!r} has changed since this run was trained (changed: {', '.join(changed)}); "
            f"{remedy}, or train a new run into another folder"
        )


def _changed_files(now: Mapping[str, str], before: Mapping[str, str]) -> list[str]:
    """Returns the names of the files that differ, or may differ."""
    names = sorted({*now, *before})
    return [name for name in names if now.get(name) != before.get(name) or now[name] == _UNKNOWN]


def _fingerprint(part: str, name: str, is_dynamic: bool) -> PartFingerprint:
    path = find_file(part, name)
    if path.suffix.lower() in MESH_SUFFIXES:
        return {"files": _hash_files(path.parent, [path]), "model": None}
    # MuJoCo keeps the files that it has read, and notices a change only after a second.
    mujoco.mj_clearCache(mujoco.mj_getCache())
    try:
        model = mujoco.MjSpec.from_file(str(path)).compile()
        dependencies = mujoco.mju_getXMLDependencies(str(path))
    except (ValueError, mujoco.FatalError) as error:
        raise SceneError(f"{part} file {str(path)!r} cannot be loaded: {one_line(error)}; correct it") from error
    files = _hash_files(path.parent, [Path(file) for file in dependencies])
    return {"files": files, "model": _hash_model(model, is_dynamic)}


def _hash_files(folder: Path, paths: Iterable[Path]) -> dict[str, str]:
    """Returns the SHA-256 of each file and of the files that it names, by its path relative to `folder`."""
    hashes: dict[str, str] = {}
    waiting = list(paths)
    while waiting:
        path = waiting.pop()
        name = os.path.relpath(path, folder)
        if name in hashes:
            continue
        content = path.read_bytes() if path.is_file() else b""
        hashes[name] = hashlib.sha256(content).hexdigest() if path.is_file() else _UNKNOWN
        waiting += _named_files(path, content)
    return dict(sorted(hashes.items()))


def _named_files(path: Path, content: bytes) -> list[Path]:
    """Returns the existing files that the mesh or material file `path` names: materials, textures, buffers."""
    pattern = _NAMED_FILES.get(path.suffix.lower())
    found: list[Path] = []
    for match in re.findall(pattern, content, re.MULTILINE) if pattern else []:
        text = urllib.parse.unquote(match.decode(errors="surrogateescape"))
        # In a material file, options may come before the name.
        candidates = [path.parent / text, path.parent / text.split()[-1]]
        found += [candidate for candidate in candidates if candidate.is_file()]
    return found


def _hash_model(model: mujoco.MjModel, is_dynamic: bool) -> str:
    """Returns the SHA-256 of the fields of a compiled model on which a run depends."""
    beginnings = tuple((_DYNAMIC_FIELDS if is_dynamic else _FIELDS).split())
    ignored = _SPEEDS if is_dynamic else _DYNAMICS
    names = {kind: [getattr(model, kind)(i).name for i in range(count)] for kind, count in _named_elements(model)}
    total = hashlib.sha256(json.dumps(names).encode())
    for field in sorted(name for name in dir(model) if name.startswith(beginnings) and not ignored.fullmatch(name)):
        value = getattr(model, field)
        if isinstance(value, np.ndarray):
            total.update(f"{field}{value.shape}{value.dtype}".encode() + np.ascontiguousarray(value).tobytes())
    return total.hexdigest()


def _named_elements(model: mujoco.MjModel) -> list[tuple[str, int]]:
    """Returns kind and number of the elements that a run finds by name."""
    return [("site", model.nsite), ("camera", model.ncam), ("numeric", model.nnumeric)]
