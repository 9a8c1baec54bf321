"""Reads all triangles of a mesh file, with normals and colours, in the frame of the file."""

from __future__ import annotations

import io
from dataclasses import dataclass, replace
from pathlib import Path

import mujoco
import numpy as np
import trimesh
from PIL import Image
from trimesh.resolvers import FilePathResolver

from vsearch_jax.scene.meshes.checks import MeshError
from vsearch_jax.scene.meshes.colours import Images, colours_of
from vsearch_jax.scene.meshes.formats import unsupported_content

# Rotations that turn an axis to +z. Those of y and -y keep x.
_TO_Z = {
    "x": ((0, 0, -1), (0, 1, 0), (1, 0, 0)),
    "-x": ((0, 0, 1), (0, 1, 0), (-1, 0, 0)),
    "y": ((1, 0, 0), (0, 0, -1), (0, 1, 0)),
    "-y": ((1, 0, 0), (0, 0, 1), (0, -1, 0)),
    "-z": ((1, 0, 0), (0, -1, 0), (0, 0, -1)),
}
_IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".tga", ".bmp", ".gif", ".tif", ".tiff", ".webp", ".dds", ".ktx2")


@dataclass(frozen=True)
class Surface:
    """F triangles of a mesh file that share a texture, or have none.

    Attributes:
      corners: f64[F, 3, 3], positions of the three corners of each triangle, in the unit of the file.
      normals: f64[F, 3, 3], unit normals at the corners, or None if the file gives none.
      colours: f32[F, 3, 3] in [0, 1], colours at the corners, or None if the file gives none.
      image: u8[H, W, 4], the texture with alpha, or None. The colours multiply its texels.
      texcoords: f64[F, 3, 2], texture coordinates of the corners, v upwards; None without texture.
    """

    corners: np.ndarray
    normals: np.ndarray | None = None
    colours: np.ndarray | None = None
    image: np.ndarray | None = None
    texcoords: np.ndarray | None = None

    def turned(self, up: str) -> Surface:
        """Returns the surface turned about the origin so that an axis of it points along +z.

        Args:
          up: the axis: "x", "y", "z", "-x", "-y" or "-z".
        """
        if up == "z":
            return self
        turn = np.array(_TO_Z[up], np.float64).T
        normals = None if self.normals is None else self.normals @ turn
        return replace(self, corners=self.corners @ turn, normals=normals)


def read_surfaces(path: Path) -> tuple[list[Surface], list[str]]:
    """Reads a mesh file whole: all its objects, at the places that its scene gives them.

    MuJoCo reads its own format MSH. trimesh reads the others. Points and lines are left out.

    Args:
      path: an existing file with a suffix of `MESH_SUFFIXES`.

    Returns:
      The surfaces, and what the file holds that cannot be drawn, in words.

    Raises:
      MeshError: the file cannot be read, or has no triangle.
    """
    if path.suffix.lower() == ".msh":
        return [_read_msh(path)], []
    losses = unsupported_content(path)
    resolver = _Resolver(str(path), allow_anywhere=True)
    try:
        scene = trimesh.load_scene(str(path), resolver=resolver, process=False)
        nodes = [scene.graph[node] for node in scene.graph.nodes_geometry]
    except Exception as error:  # The readers of trimesh raise exceptions of many types.
        raise MeshError(f"it is not a readable mesh ({' '.join(str(error).split())}); export it again") from error
    surfaces: list[Surface] = []
    images = Images()
    for transform, name in nodes:
        mesh = scene.geometry[name]
        if not isinstance(mesh, trimesh.Trimesh):
            losses.append("points and lines")
        elif len(mesh.faces):
            surface, of_mesh = _surface(mesh, transform, images)
            surfaces.append(surface)
            losses += of_mesh
    if not surfaces:
        raise MeshError("it has no triangle; export a surface, not points or lines")
    return surfaces, list(dict.fromkeys([*losses, *resolver.losses]))


class _Resolver(FilePathResolver):
    """Finds the files that a mesh file names, such as its textures, and notes those that cannot be read."""

    def __init__(self, source: str, allow_anywhere: bool) -> None:
        super().__init__(source, allow_anywhere=allow_anywhere)
        self.losses: list[str] = []

    def get(self, name: str) -> bytes:
        """Returns the content of a file.

        Args:
          name: path of the file, relative to the mesh file.

        Raises:
          FileNotFoundError: the file does not exist.
        """
        try:
            content = super().get(name)
        except FileNotFoundError:
            self.losses.append(f"the file {name.strip()!r} that it names, which does not exist")
            raise
        if Path(name.strip()).suffix.lower() in _IMAGE_SUFFIXES:
            try:
                Image.open(io.BytesIO(content))
            except Exception:  # trimesh skips such an image without a word, whatever Pillow raises.
                self.losses.append(f"the file {name.strip()!r} that it names, which is no readable image")
        return content


def _surface(mesh: trimesh.Trimesh, transform: np.ndarray, images: Images) -> tuple[Surface, list[str]]:
    """Returns the triangles of a mesh that a scene has placed by `transform`, and what cannot be drawn of them."""
    colours = colours_of(mesh, images)
    corners = np.asarray(mesh.vertices, np.float64)[mesh.faces]
    # trimesh computes normals where the file gives none; those from the file are in its cache.
    normals = np.asarray(mesh.vertex_normals)[mesh.faces] if "vertex_normals" in mesh._cache else None
    arrays = [corners, normals, colours.corners, colours.texcoords]
    if not np.array_equal(transform, np.eye(4)):
        linear = np.asarray(transform)[:3, :3]
        arrays[0] = corners @ linear.T + np.asarray(transform)[:3, 3]
        # The matrix of cofactors maps normals; a mirror turns the order of the corners.
        cofactors = np.cross(linear[[1, 2, 0]], linear[[2, 0, 1]])
        arrays[1] = None if normals is None else normals @ cofactors.T
        if np.linalg.det(linear) < 0.0:
            arrays[1] = None if arrays[1] is None else -arrays[1]
            arrays = [None if array is None else array[:, ::-1] for array in arrays]
    placed, turned, painted, texcoords = arrays
    assert placed is not None
    return Surface(placed, _unit(turned), painted, colours.image, texcoords), colours.losses


def _unit(normals: np.ndarray | None) -> np.ndarray | None:
    """Returns unit normals; None if a normal is not finite or 0."""
    if normals is None:
        return None
    length = np.linalg.norm(normals, axis=-1, keepdims=True)
    is_usable = np.isfinite(length).all() and np.all(length > 0.0)
    return normals / length if is_usable else None


def _read_msh(path: Path) -> Surface:
    """Reads a file of MuJoCo's own format MSH."""
    spec = mujoco.MjSpec()
    spec.add_mesh(name="mesh", file=str(path), inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL)
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname="mesh")
    try:
        model = spec.compile()
    except ValueError as error:
        raise MeshError(
            f"it is no MSH file of MuJoCo ({' '.join(str(error).split())}); export it as OBJ, STL or GLB"
        ) from error
    rotation = np.zeros(9)
    mujoco.mju_quat2Mat(rotation, model.mesh_quat[0])
    rotation = rotation.reshape(3, 3)
    vertices = model.mesh_vert @ rotation.T + model.mesh_pos[0]
    return Surface(vertices[model.mesh_face], (model.mesh_normal @ rotation.T)[model.mesh_facenormal])
