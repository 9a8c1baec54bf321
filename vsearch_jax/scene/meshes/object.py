"""Makes the object of a scene from a mesh file."""

from __future__ import annotations

import logging
from pathlib import Path

import mujoco
import numpy as np

from vsearch_jax.config import SceneConfig
from vsearch_jax.scene.meshes.checks import MeshError, check_mesh, weld
from vsearch_jax.scene.meshes.formats import up_axis
from vsearch_jax.scene.meshes.parts import Part, split_parts
from vsearch_jax.scene.meshes.reading import read_surfaces

# m. Smallest edge of the box that stands for a flat object where the arm avoids it.
_MIN_BOX = 1e-3
# MuJoCo refuses a mesh with fewer vertices.
_MIN_VERTICES = 4
# MuJoCo's convention: group 3 holds shapes for collisions. The renderer does not draw it.
_COLLISION_GROUP = 3

_LOG = logging.getLogger(__name__)


def load_mesh(path: Path, config: SceneConfig) -> mujoco.MjSpec:
    """Loads a mesh file as the geoms of one body, checks it, and moves it onto the table if the config says so.

    Each material of the file is a geom. A file of one material is avoided by the arm as its convex hull. Flat files and
    files of several materials are avoided as their bounding box, an invisible geom. What cannot be drawn, faults of the
    mesh, and an up axis other than z are logged.

    Args:
      path: an existing file with a suffix of `MESH_SUFFIXES`.
      config: scale, up axis and placement of the mesh; radius in m of the view sphere, which is its maximum size.

    Raises:
      MeshError: the file cannot be read, or the mesh is too large or too small.
    """
    surfaces, losses = read_surfaces(path)
    up = up_axis(path) if config.mesh_up == "auto" else config.mesh_up
    surfaces = [surface.turned(up) for surface in surfaces]
    corners = np.concatenate([surface.corners for surface in surfaces]) * config.mesh_scale
    report = check_mesh(corners.astype(np.float32).astype(np.float64), config.radius)  # MuJoCo stores f32.
    if losses:
        _LOG.warning("object file %r: these are not drawn: %s", str(path), "; ".join(losses))
    if up != "z":
        _LOG.warning("object file %r: its %s axis points up; set SceneConfig.mesh_up to change that", str(path), up)
    if report.num_degenerate or report.num_open_edges:
        _LOG.warning("object file %r: %s", str(path), report)
    return _build(split_parts(surfaces), config)


def _build(parts: list[Part], config: SceneConfig) -> mujoco.MjSpec:
    """Returns the object. MuJoCo decides whether its one part has a convex hull."""
    if len(parts) == 1:
        try:
            return _assemble(parts, config, is_hull=True)
        except ValueError:  # MuJoCo finds no convex hull of a flat mesh.
            pass
    try:
        return _assemble(parts, config, is_hull=False)
    except ValueError as error:
        raise MeshError(f"MuJoCo refuses it ({' '.join(str(error).split())}); repair it, or export it again") from error


def _assemble(parts: list[Part], config: SceneConfig, is_hull: bool) -> mujoco.MjSpec:
    spec = mujoco.MjSpec()
    body = spec.worldbody.add_body(name="mesh")
    for number, part in enumerate(parts):
        _add_part(spec, body, part, f"mesh{number or ''}", config.mesh_scale)
    geoms = list(body.geoms)
    if not is_hull:
        for geom in geoms:
            geom.contype = geom.conaffinity = 0
            geom.mass = 0.0  # MuJoCo may refuse the inertia of a flat mesh by rounding.
    vertices = _vertices_in_file_frame(spec.compile())
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    shift = np.array([-(low[0] + high[0]) / 2.0, -(low[1] + high[1]) / 2.0, -low[2]]) * config.is_mesh_recentred
    for geom in geoms:
        geom.pos = shift
    if not is_hull:
        body.add_geom(
            name="bounding_box",
            type=mujoco.mjtGeom.mjGEOM_BOX,
            size=np.maximum(high - low, _MIN_BOX) / 2.0,
            pos=(low + high) / 2.0 + shift,
            rgba=[0.0, 0.0, 0.0, 0.0],
            group=_COLLISION_GROUP,
        )
    return spec


def _add_part(spec: mujoco.MjSpec, body: mujoco.MjsBody, part: Part, name: str, scale: float) -> None:
    """Adds a part as a geom; its mesh, texture, material and geom are all called `name`."""
    # MuJoCo 4.0 keeps given normals only if there is one for each vertex.
    corners = part.corners if part.normals is None else np.concatenate([part.corners, part.normals], axis=-1)
    vertices, faces = weld(corners)
    if len(vertices) < _MIN_VERTICES:
        vertices = np.concatenate([vertices, vertices[:1].repeat(_MIN_VERTICES - len(vertices), axis=0)])
    # The object does not move, so its inertia has no effect. The inertia of a shell exists for meshes with holes, too.
    mesh = spec.add_mesh(name=name, inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL)
    mesh.uservert, mesh.userface = vertices[:, :3].reshape(-1), faces.reshape(-1)
    mesh.scale = [scale] * 3
    if part.normals is not None:
        mesh.usernormal, mesh.userfacenormal = vertices[:, 3:].reshape(-1), faces.reshape(-1)
    geom = body.add_geom(name=name, type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name)
    if part.image is None or part.texcoords is None:
        geom.rgba = [*part.rgb, 1.0]
        return
    # MuJoCo counts v downwards from the top row.
    mesh.usertexcoord = np.stack([part.texcoords[..., 0], 1.0 - part.texcoords[..., 1]], axis=-1).reshape(-1)
    mesh.userfacetexcoord = np.arange(faces.size)
    height, width, channels = part.image.shape
    texture = spec.add_texture(name=name, type=mujoco.mjtTexture.mjTEXTURE_2D)
    texture.width, texture.height, texture.nchannel = width, height, channels
    texture.colorspace = mujoco.mjtColorSpace.mjCOLORSPACE_LINEAR
    texture.data = part.image.tobytes()
    material = spec.add_material(name=name, rgba=[*part.rgb, 1.0])
    textures = list(material.textures)
    textures[int(mujoco.mjtTextureRole.mjTEXROLE_RGB)] = name
    material.textures = textures
    geom.material = name


def _vertices_in_file_frame(model: mujoco.MjModel) -> np.ndarray:
    """Returns f64[V, 3] m, the scaled vertices of the model's meshes in the frame of their file."""
    result = []
    for mesh in range(model.nmesh):
        # MuJoCo moved the vertices into the frame of the mesh's inertia.
        rotation = np.zeros(9)
        mujoco.mju_quat2Mat(rotation, model.mesh_quat[mesh])
        first, count = int(model.mesh_vertadr[mesh]), int(model.mesh_vertnum[mesh])
        vertices = model.mesh_vert[first : first + count]
        result.append(vertices @ rotation.reshape(3, 3).T + model.mesh_pos[mesh])
    return np.concatenate(result)
