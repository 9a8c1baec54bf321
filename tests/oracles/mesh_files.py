"""Compares the object that a mesh file becomes with what trimesh reads: triangles, size, up axis, colours.

As a program it prints a table of files, each scaled to 0.1 m:

python tests/oracles/mesh_files.py FILE_OR_FOLDER ...
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import mujoco
import numpy as np
import trimesh
from scipy.ndimage import map_coordinates
from scipy.spatial import cKDTree

from vsearch_jax.config import SceneConfig
from vsearch_jax.scene import SceneError
from vsearch_jax.scene.files import load_object

SUFFIXES = (".obj", ".stl", ".ply", ".glb", ".gltf", ".dae", ".3mf", ".off")
BROWN = np.array([0.75, 0.55, 0.35])
BARYCENTRIC = np.array([[0.6, 0.2, 0.2], [0.2, 0.6, 0.2], [0.2, 0.2, 0.6], [1 / 3, 1 / 3, 1 / 3]])
# Turns +y to +z, about x.
Y_TO_Z = trimesh.transformations.rotation_matrix(np.pi / 2, [1, 0, 0])
MAX_FACES = 2000


class Comparison(NamedTuple):
    """An object and trimesh's scene.

    Attributes:
      num_faces: triangles of the object's visible geoms.
      num_faces_trimesh: triangles of trimesh's scene.
      max_distance: largest distance of a face's centroid from the nearest one of the other, as a share of the length.
      extents: f64[3] m, edges of the object's bounding box.
      extents_trimesh: f64[3] m, of trimesh's scene, turned to z up and scaled.
      colour_error: mean difference of the colours at four points of up to 2,000 faces, in 1/255.
      num_colours: number of different colours among these points, of trimesh.
    """

    num_faces: int
    num_faces_trimesh: int
    max_distance: float
    extents: np.ndarray
    extents_trimesh: np.ndarray
    colour_error: float
    num_colours: int


def compare(path: Path, config: SceneConfig, is_y_up: bool) -> Comparison:
    """Loads a file as an object and by trimesh, and compares the two."""
    triangles, colours = _of_trimesh(path, is_y_up)
    triangles *= config.mesh_scale
    low, high = triangles.min(axis=(0, 1)), triangles.max(axis=(0, 1))
    triangles -= [*(low + high)[:2] / 2, low[2]]
    model = load_object(path, config).compile()
    ours, evaluate = _of_model(model)
    tree, centroids = cKDTree(ours.mean(axis=1)), triangles.mean(axis=1)
    distance = [tree.query(centroids)[0].max(), cKDTree(centroids).query(ours.mean(axis=1))[0].max()]
    has_area = np.linalg.norm(np.cross(*(triangles[:, i] - triangles[:, 0] for i in (1, 2))), axis=1) > 1e-12
    usable = np.flatnonzero(has_area)
    chosen = np.random.default_rng(0).permutation(usable)[:MAX_FACES]
    points = np.einsum("pc,fcx->fpx", BARYCENTRIC, triangles[chosen])
    expected = np.stack([colours(chosen, weights) for weights in BARYCENTRIC], axis=1)
    actual = evaluate(tree.query(centroids[chosen])[1], points)
    return Comparison(
        num_faces=len(ours),
        num_faces_trimesh=len(triangles),
        max_distance=float(max(distance) / (high - low).max()),
        extents=np.ptp(ours, axis=(0, 1)),
        extents_trimesh=high - low,
        colour_error=float(255.0 * np.abs(expected - actual).mean()),
        num_colours=len(np.unique(np.round(expected.reshape(-1, 3) * 255), axis=0)),
    )


def _of_trimesh(path: Path, is_y_up: bool):
    """Returns the triangles f64[F, 3, 3], and a function of faces and barycentric weights to colours f64[N, 3]."""
    meshes = [mesh for mesh in trimesh.load_scene(str(path)).dump() if isinstance(mesh, trimesh.Trimesh)]
    triangles = np.concatenate([np.asarray(mesh.triangles) for mesh in meshes])
    if is_y_up:
        triangles = trimesh.transform_points(triangles.reshape(-1, 3), Y_TO_Z).reshape(-1, 3, 3)
    starts = np.cumsum([0, *(len(mesh.faces) for mesh in meshes)])

    def colours(faces: np.ndarray, weights: np.ndarray) -> np.ndarray:
        result = np.empty((len(faces), 3))
        for mesh, start, stop in zip(meshes, starts[:-1], starts[1:], strict=True):
            rows = np.flatnonzero((faces >= start) & (faces < stop))
            if len(rows):
                result[rows] = _colours_of_mesh(mesh, faces[rows] - start, weights)
        return result

    return triangles, colours


def _colours_of_mesh(mesh: trimesh.Trimesh, faces: np.ndarray, weights: np.ndarray) -> np.ndarray:
    visual = mesh.visual
    if visual.kind == "face":
        return visual.face_colors[faces, :3] / 255.0
    if visual.kind == "vertex":
        return np.einsum("c,fcx->fx", weights, visual.vertex_colors[mesh.faces[faces]][..., :3] / 255.0)
    if visual.kind is None:
        return np.tile(BROWN, (len(faces), 1))
    material = visual.material
    is_pbr = isinstance(material, trimesh.visual.material.PBRMaterial)
    image = material.baseColorTexture if is_pbr else material.image
    is_without_colour = not is_pbr and image is not None and image.size == (2, 2)  # trimesh's stand-in
    if is_without_colour:
        return np.tile(BROWN, (len(faces), 1))
    factor = np.ones(4) * 255 if is_pbr and material.baseColorFactor is None else material.main_color
    if image is None or visual.uv is None:
        return np.tile(factor[:3] / 255.0, (len(faces), 1))
    uv = np.einsum("c,fcx->fx", weights, visual.uv[mesh.faces[faces]])
    # trimesh's own lookup stretches the texture by one texel; OpenGL's texel centres lie at half texels.
    picture = np.asarray(image.convert("RGB")) / 255.0
    place = [(1.0 - uv[:, 1]) * image.height - 0.5, uv[:, 0] * image.width - 0.5]
    texels = np.stack([map_coordinates(picture[..., i], place, order=1, mode="grid-wrap") for i in range(3)], axis=1)
    return texels * factor[:3] / 255.0 if is_pbr else texels


def _of_model(model: mujoco.MjModel):
    """Returns the visible triangles in world, and a function of faces and points f64[N, P, 3] to colours."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    triangles, geoms, texcoords = [], [], []
    for geom in np.flatnonzero(model.geom_rgba[:, 3] > 0):
        mesh = model.geom_dataid[geom]
        faces = model.mesh_face[model.mesh_faceadr[mesh] :][: model.mesh_facenum[mesh]]
        vertices = model.mesh_vert[model.mesh_vertadr[mesh] :][: model.mesh_vertnum[mesh]].astype(np.float64)
        triangles.append((vertices @ data.geom_xmat[geom].reshape(3, 3).T + data.geom_xpos[geom])[faces])
        geoms.append(np.full(len(faces), geom))
        texcoords.append(np.zeros((len(faces), 3, 2)))
        if model.mesh_texcoordadr[mesh] >= 0:
            index = model.mesh_facetexcoord[model.mesh_faceadr[mesh] :][: model.mesh_facenum[mesh]]
            texcoords[-1] = model.mesh_texcoord[model.mesh_texcoordadr[mesh] :][index].astype(np.float64)
    corners, geom_of, uv_of = (np.concatenate(arrays) for arrays in (triangles, geoms, texcoords))

    def evaluate(faces: np.ndarray, points: np.ndarray) -> np.ndarray:
        result = np.empty(points.shape)
        for place in range(points.shape[1]):
            weights = trimesh.triangles.points_to_barycentric(corners[faces], points[:, place])
            uv = np.einsum("fc,fcx->fx", weights, uv_of[faces])
            for geom in np.unique(geom_of[faces]):
                rows = np.flatnonzero(geom_of[faces] == geom)
                result[rows, place] = _colour_of_geom(model, geom, uv[rows])
        return result

    return corners, evaluate


def _colour_of_geom(model: mujoco.MjModel, geom: int, uv: np.ndarray) -> np.ndarray:
    """Returns the colours of a geom at texture coordinates, by OpenGL's bilinear filter (GL_REPEAT)."""
    material = model.geom_matid[geom]
    if material < 0:
        return np.tile(model.geom_rgba[geom, :3], (len(uv), 1))
    texture = model.mat_texid[material, int(mujoco.mjtTextureRole.mjTEXROLE_RGB)]
    height, width = model.tex_height[texture], model.tex_width[texture]
    start = model.tex_adr[texture]
    image = model.tex_data[start : start + height * width * 3].reshape(height, width, 3) / 255.0
    place = uv * [width, height] - 0.5
    first = np.floor(place).astype(int)
    (fu, fv), (u, v) = (place - first).T[..., None], first.T
    rows = [(1 - fu) * image[w % height, u % width] + fu * image[w % height, (u + 1) % width] for w in (v, v + 1)]
    return ((1 - fv) * rows[0] + fv * rows[1]) * model.mat_rgba[material, :3]


def _files(arguments: list[str]) -> Iterator[Path]:
    for path in map(Path, arguments):
        yield from sorted(path.rglob("*")) if path.is_dir() else [path]


def main() -> None:
    """Prints the table."""
    print("| file | faces | trimesh | centroids, share of length | extents, max. difference in mm | colours | error |")
    print("|---|---|---|---|---|---|---|")
    for path in (path for path in _files(sys.argv[1:]) if path.suffix.lower() in SUFFIXES):
        try:
            scale = 0.1 / float(max(trimesh.load_scene(str(path)).extents))
            config = SceneConfig(object=str(path), mesh_scale=scale)
            is_y_up = path.suffix.lower() in (".glb", ".gltf") or (
                path.suffix.lower() == ".dae" and b"Z_UP" not in path.read_bytes()
            )
            result = compare(path.resolve(), config, is_y_up)
        except (SceneError, TypeError, ValueError, ZeroDivisionError) as error:
            print(f"| {path.name} | refused: {str(error)[-90:]} | | | | | |")
            continue
        difference = 1000.0 * np.abs(result.extents - result.extents_trimesh).max()
        print(
            f"| {path.name} | {result.num_faces} | {result.num_faces_trimesh} | {result.max_distance:.0e} | "
            f"{difference:.0e} | {result.num_colours} | {result.colour_error:.2f} |"
        )


if __name__ == "__main__":
    main()
