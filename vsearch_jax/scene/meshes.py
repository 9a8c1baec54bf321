"""Reads and checks mesh files."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh

MESH_SUFFIXES = (".obj", ".stl", ".msh", ".ply", ".glb", ".gltf", ".off")
# MuJoCo reads these files itself, which keeps normals and texture coordinates.
_READ_BY_MUJOCO = (".obj", ".stl", ".msh")
_MAX_STL_FACES = 200_000

# m. A smaller object covers only a few pixels of the wrist camera's image.
_MIN_SIZE = 0.005


class MeshError(ValueError):
    """A mesh file cannot be used. The message has one line; it names the problem and the remedy."""


@dataclass(frozen=True)
class MeshReport:
    """Size and faults of a mesh.

    Attributes:
      num_faces: number of triangles.
      num_degenerate: number of triangles without area.
      num_open_edges: number of edges that belong to exactly one triangle; they bound the holes.
      size: f64[3], edges of the bounding box, in the unit of the vertices.
    """

    num_faces: int
    num_degenerate: int
    num_open_edges: int
    size: np.ndarray

    def __str__(self) -> str:
        """Returns the report in one line."""
        faults = [f"{self.num_degenerate} of them without area"] if self.num_degenerate else []
        faults += [f"{self.num_open_edges} edges at holes"] if self.num_open_edges else []
        extent = " x ".join(f"{edge:.3g}" for edge in self.size)
        return ", ".join([f"{self.num_faces} faces", *(faults or ["closed"]), f"size {extent}"])


def read_mesh(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Reads the triangles of a mesh file: vertices f64[V, 3] and faces i32[F, 3] (numbers of vertices).

    The vertices are in the unit of the file. All parts of the file are merged.

    Raises:
      MeshError: the file cannot be read, or has no triangle.
    """
    try:
        mesh = trimesh.load_mesh(path)
        mesh = mesh.to_mesh() if isinstance(mesh, trimesh.Scene) else mesh
        vertices, faces = np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int32)
    except Exception as error:  # The readers of trimesh raise exceptions of many types.
        raise MeshError(f"it is not a readable mesh ({' '.join(str(error).split())}); export it again") from error
    if not len(faces):
        raise MeshError("it has no triangle; export a surface, not points or lines")
    return vertices, faces


def inspect_mesh(vertices: np.ndarray, faces: np.ndarray) -> MeshReport:
    """Measures the size of a mesh and counts its faults: triangles without area and edges of holes.

    Vertices at equal positions count as one vertex.

    Args:
      vertices: f64[V, 3], positions of V vertices, in any unit.
      faces: i32[F, 3], numbers of the vertices of F triangles.

    Returns:
      The size and the counts.
    """
    positions, index = np.unique(vertices, axis=0, return_inverse=True)
    faces = index.reshape(-1)[faces]
    a, b, c = (positions[faces[:, i]] for i in range(3))
    double_area = np.linalg.norm(np.cross(b - a, c - a), axis=-1)
    is_degenerate = double_area <= 1e-12 * np.square(np.ptp(positions, axis=0)).sum()
    good = faces[~is_degenerate]
    edges = np.sort(np.concatenate([good[:, [0, 1]], good[:, [1, 2]], good[:, [2, 0]]]), axis=1)
    _, num_uses = np.unique(edges, axis=0, return_counts=True)
    return MeshReport(len(faces), int(is_degenerate.sum()), int((num_uses == 1).sum()), np.ptp(vertices, axis=0))


def check_mesh(vertices: np.ndarray, faces: np.ndarray, max_size: float) -> MeshReport:
    """Checks that a mesh has a size and a shape that the wrist camera can see.

    Args:
      vertices: f64[V, 3] m, positions of V vertices.
      faces: i32[F, 3], numbers of the vertices of F triangles.
      max_size: m, maximum length of the longest edge of the bounding box.

    Returns:
      Size and faults of the mesh, from `inspect_mesh`.

    Raises:
      MeshError: a coordinate is not finite, all faces lack area, or the mesh is too large or too small.
    """
    if not np.isfinite(vertices).all():
        raise MeshError("it has vertices that are not finite; repair it")
    report = inspect_mesh(vertices, faces)
    if report.num_degenerate == report.num_faces:
        raise MeshError(f"all its {report.num_faces} faces lack area; export it again")
    size = float(report.size.max())
    if size > max_size:
        raise MeshError(
            f"it is {size:.3g} m long, but the maximum is {max_size:.3g} m; "
            "if its unit is millimetres, set SceneConfig.mesh_scale to 0.001"
        )
    if size < _MIN_SIZE:
        raise MeshError(
            f"it is {size:.3g} m long, but the minimum is {_MIN_SIZE} m; "
            "set SceneConfig.mesh_scale to the length of its unit in metres"
        )
    return report


def is_read_by_mujoco(path: Path) -> bool:
    """Returns whether MuJoCo can read a mesh file itself. It reads binary STL files of up to 200,000 faces only.

    Args:
      path: an existing file with a suffix of `MESH_SUFFIXES`.
    """
    if path.suffix.lower() == ".stl":
        with path.open("rb") as file:
            header = file.read(84)
        num_faces = int.from_bytes(header[80:], "little")
        return path.stat().st_size == 84 + 50 * num_faces and num_faces <= _MAX_STL_FACES
    return path.suffix.lower() in _READ_BY_MUJOCO
