"""Size and faults of a mesh."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

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


def inspect_mesh(corners: np.ndarray) -> MeshReport:
    """Measures the size of a mesh and counts its faults: triangles without area and edges of holes.

    Corners at equal positions count as one vertex.

    Args:
      corners: f64[F, 3, 3], positions of the three corners of F triangles, in any unit.

    Returns:
      The size and the counts.
    """
    positions, faces = weld(corners)
    double_area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=-1)
    size = np.ptp(positions, axis=0)
    is_degenerate = double_area <= 1e-12 * np.square(size).sum()
    good = faces[~is_degenerate]
    edges = np.sort(np.concatenate([good[:, [0, 1]], good[:, [1, 2]], good[:, [2, 0]]]), axis=1)
    _, num_uses = np.unique(edges[:, 0] * len(positions) + edges[:, 1], return_counts=True)
    return MeshReport(len(faces), int(is_degenerate.sum()), int((num_uses == 1).sum()), size)


def weld(corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Merges corners that are exactly equal, in the order of first use, as MuJoCo's reader of STL files does.

    Args:
      corners: f64[F, 3, D], positions of the corners of F triangles, and other values that must be equal too.

    Returns:
      f64[V, D], the different corners; and int[F, 3], the number of each corner among them.
    """
    rows = corners.reshape(-1, corners.shape[-1])
    order = np.lexsort(rows.T)
    ordered = rows[order]
    is_new = np.append(True, np.any(ordered[1:] != ordered[:-1], axis=1))
    # lexsort is stable, so the first corner of each run of equal ones is the first in the file.
    first = order[is_new]
    rank = np.empty(len(first), int)
    rank[np.argsort(first)] = np.arange(len(first))
    index = np.empty(len(rows), int)
    index[order] = rank[np.cumsum(is_new) - 1]
    return rows[np.sort(first)], index.reshape(-1, 3)


def check_mesh(corners: np.ndarray, max_size: float) -> MeshReport:
    """Checks that a mesh has a size and a shape that the wrist camera can see.

    Args:
      corners: f64[F, 3, 3] m, positions of the corners of F triangles.
      max_size: m, maximum length of the longest edge of the bounding box.

    Returns:
      Size and faults of the mesh, from `inspect_mesh`.

    Raises:
      MeshError: a coordinate is not finite, all faces lack area, or the mesh is too large or too small.
    """
    if not np.isfinite(corners).all():
        raise MeshError("it has vertices that are not finite; repair it")
    report = inspect_mesh(corners)
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
