"""Mesh files: read, inspected, and refused where nothing could be seen of them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh

MESH_SUFFIXES = (".obj", ".stl", ".msh", ".ply", ".glb", ".gltf", ".off")
# A file of these suffixes is MuJoCo's own to read, so that normals and texture coordinates stay.
_READ_BY_MUJOCO = (".obj", ".stl", ".msh")

# The least size of an object, in m, of which a camera at arm's length shows more than a few pixels.
_LEAST_SIZE = 0.005


class MeshError(ValueError):
    """A mesh file cannot be used; the one-line message names the problem and the remedy."""


@dataclass(frozen=True)
class MeshReport:
    """What a mesh is like.

    Attributes:
      num_faces: triangles.
      num_degenerate: triangles without area.
      num_open_edges: edges that belong to one triangle only: the rims of holes.
      size: f64[3] in the file's unit, edges of the bounding box.
    """

    num_faces: int
    num_degenerate: int
    num_open_edges: int
    size: np.ndarray

    def __str__(self) -> str:
        """Returns one line."""
        faults = [f"{self.num_degenerate} of them without area"] if self.num_degenerate else []
        faults += [f"{self.num_open_edges} edges at holes"] if self.num_open_edges else []
        extent = " x ".join(f"{edge:.3g}" for edge in self.size)
        return ", ".join([f"{self.num_faces} faces", *(faults or ["closed"]), f"size {extent}"])


def read_mesh(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Returns vertices f64[V, 3] and faces i32[F, 3] of a file, all its parts in one.

    Raises:
      MeshError: the file cannot be read or holds no triangle.
    """
    try:
        mesh = trimesh.load_mesh(path)
        mesh = mesh.to_mesh() if isinstance(mesh, trimesh.Scene) else mesh
        vertices, faces = np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int32)
    except Exception as error:  # trimesh raises whatever its many readers do
        raise MeshError(f"it cannot be read as a mesh ({' '.join(str(error).split())}); export it anew") from error
    if not len(faces):
        raise MeshError("it holds no triangle; export the surface, not points or lines")
    return vertices, faces


def inspect(vertices: np.ndarray, faces: np.ndarray) -> MeshReport:
    """Returns what a mesh with `vertices` [V, 3] and `faces` [F, 3] is like; vertices in one place count as one."""
    places, index = np.unique(vertices, axis=0, return_inverse=True)
    faces = index.reshape(-1)[faces]
    a, b, c = (places[faces[:, i]] for i in range(3))
    is_degenerate = np.linalg.norm(np.cross(b - a, c - a), axis=-1) <= 1e-12 * np.square(np.ptp(places, axis=0)).sum()
    good = faces[~is_degenerate]
    edges = np.sort(np.concatenate([good[:, [0, 1]], good[:, [1, 2]], good[:, [2, 0]]]), axis=1)
    _, uses = np.unique(edges, axis=0, return_counts=True)
    return MeshReport(len(faces), int(is_degenerate.sum()), int((uses == 1).sum()), np.ptp(vertices, axis=0))


def check(vertices: np.ndarray, faces: np.ndarray, largest: float) -> MeshReport:
    """Returns the report of a mesh that can be looked at.

    Args:
      vertices: f64[V, 3] m.
      faces: i32[F, 3].
      largest: m, the longest edge of a bounding box that can be looked at.

    Raises:
      MeshError: coordinates are not finite, all faces lack area, or the size fits no unit that is metres.
    """
    if not np.isfinite(vertices).all():
        raise MeshError("it has vertices that are not finite; repair it")
    report = inspect(vertices, faces)
    if report.num_degenerate == report.num_faces:
        raise MeshError(f"all its {report.num_faces} faces lack area; export it anew")
    size = float(report.size.max())
    if size > largest:
        raise MeshError(
            f"it is {size:.3g} m long, and {largest:.3g} m can be looked at; "
            "if its unit is millimetres, set SceneConfig.mesh_scale to 0.001"
        )
    if size < _LEAST_SIZE:
        raise MeshError(f"it is {size:.3g} m long, less than {_LEAST_SIZE} m; set SceneConfig.mesh_scale")
    return report


def is_read_by_mujoco(path: Path) -> bool:
    """Returns whether MuJoCo reads files of this kind."""
    return path.suffix.lower() in _READ_BY_MUJOCO
