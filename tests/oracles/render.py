"""Oracles of the renderer: C MuJoCo's rays, and random scenes to compare on."""

from __future__ import annotations

from typing import NamedTuple

import mujoco
import numpy as np
from mujoco import mjtGeom, mjtLightType

# Upper bound on the geoms of a random scene, meshes and the height field included.
MAX_GEOMS = 40
SOLIDS = tuple(getattr(mjtGeom, f"mjGEOM_{name}") for name in ("SPHERE", "CAPSULE", "ELLIPSOID", "CYLINDER", "BOX"))


class Poses(NamedTuple):
    """The fields of mjx.Data that `render` and `camera` read, as NumPy arrays."""

    geom_xpos: np.ndarray
    geom_xmat: np.ndarray
    cam_xpos: np.ndarray
    cam_xmat: np.ndarray


def poses(model: mujoco.MjModel, data: mujoco.MjData) -> Poses:
    """Returns the poses of `data` in f32, without `vsearch_jax.render.poses`."""
    rotations = data.geom_xmat.reshape(model.ngeom, 3, 3).astype(np.float32)
    cameras = data.cam_xmat.reshape(model.ncam, 3, 3).astype(np.float32)
    return Poses(data.geom_xpos.astype(np.float32), rotations, data.cam_xpos.astype(np.float32), cameras)


def random_size(kind: int, rng: np.random.Generator) -> np.ndarray:
    """Returns f64[3] m, a random geom_size; entries that the geom type does not use are 0."""
    used = {mjtGeom.mjGEOM_SPHERE: 1, mjtGeom.mjGEOM_CAPSULE: 2, mjtGeom.mjGEOM_CYLINDER: 2, mjtGeom.mjGEOM_PLANE: 2}
    size = rng.uniform(0.05, 0.5, size=3)
    size[used.get(mjtGeom(kind), 3) :] = 0.0
    return size


def random_closed_mesh(rng: np.random.Generator, count: int = 9) -> tuple[np.ndarray, np.ndarray]:
    """Returns a random closed mesh that is star-shaped but not convex.

    Args:
      rng: random generator.
      count: number of bands between the poles; a band has 2 * count vertices around.

    Returns:
      Vertices f64[V, 3] m, and faces i32[4 * count * (count - 1), 3].
    """
    polar, around = np.linspace(0.0, np.pi, count + 1), np.linspace(0.0, 2 * np.pi, 2 * count, endpoint=False)
    ring = np.stack([np.cos(around), np.sin(around), np.zeros_like(around)], axis=-1)
    rings = np.sin(polar[1:-1])[:, None, None] * ring + np.cos(polar[1:-1])[:, None, None] * [0.0, 0.0, 1.0]
    vertices = np.concatenate([[[0.0, 0.0, 1.0]], rings.reshape(-1, 3), [[0.0, 0.0, -1.0]]])
    vertices *= rng.uniform(0.7, 1.3, size=(len(vertices), 1)) * rng.uniform(0.08, 0.3, size=3)
    index = 1 + np.arange(2 * count * (count - 1)).reshape(count - 1, 2 * count)
    following, last = np.roll(index, -1, axis=1), len(vertices) - 1
    faces = [np.stack([np.zeros_like(index[0]), index[0], following[0]], axis=-1)]
    faces += [
        np.stack([index[:-1], index[1:], following[1:]], axis=-1),
        np.stack([index[:-1], following[1:], following[:-1]], axis=-1),
    ]
    faces += [np.stack([np.full_like(index[0], last), following[-1], index[-1]], axis=-1)]
    return vertices, np.concatenate([f.reshape(-1, 3) for f in faces])


def add_triangles(spec: mujoco.MjSpec, rng: np.random.Generator, num_meshes: int, is_open: bool = False) -> list:
    """Adds a height field and meshes to a model, each in its own body.

    Args:
      spec: model to change.
      rng: random generator.
      num_meshes: number of meshes.
      is_open: whether every second mesh lacks its last face.

    Returns:
      The new geoms.
    """
    field = spec.add_hfield(name="field", nrow=7, ncol=9, size=[0.5, 0.4, 0.2, 0.1], userdata=rng.uniform(size=63))
    body = spec.worldbody.add_body(pos=rng.uniform(-0.7, 0.7, size=3), quat=rng.normal(size=4))
    geoms = [body.add_geom(type=mjtGeom.mjGEOM_HFIELD, hfieldname=field.name)]
    for index in range(num_meshes):
        vertices, faces = random_closed_mesh(rng)
        faces = faces[: -1 if is_open and index % 2 else None]
        name, shell = f"mesh{index}", mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
        spec.add_mesh(name=name, uservert=vertices.reshape(-1), userface=faces.reshape(-1), inertia=shell)
        body = spec.worldbody.add_body(pos=rng.uniform(-0.9, 0.9, size=3), quat=rng.normal(size=4))
        geoms.append(body.add_geom(type=mjtGeom.mjGEOM_MESH, meshname=name))
    return geoms


def random_scene(
    rng: np.random.Generator, num_geoms: int = 20, light: mjtLightType | None = None, num_meshes: int = 0
) -> mujoco.MjModel:
    """Returns a random model with a camera `eye`. It has a finite plane, an endless plane and some solids.

    Args:
      rng: random generator.
      num_geoms: number of solids, each in its own body.
      light: None for random colours and the headlight. Otherwise all geoms are white, and the only light is of this
        type and purely ambient: pixels that it reaches are white, and pixels in its shadow are black.
      num_meshes: number of meshes. If positive, there is a height field too. Without `light`, every second mesh is
        open.
    """
    spec = mujoco.MjSpec()
    world = spec.worldbody
    plane = world.add_body(pos=[0, 0, -0.6]).add_geom(type=mjtGeom.mjGEOM_PLANE, size=[0, 0, 1])
    tile = world.add_body(pos=[0.3, 0.2, -0.4], quat=rng.normal(size=4))
    geoms = [plane, tile.add_geom(type=mjtGeom.mjGEOM_PLANE, size=[0.5, 0.3, 1])]
    for index in range(num_geoms):
        kind = SOLIDS[index % len(SOLIDS)]
        body = world.add_body(pos=rng.uniform(-0.9, 0.9, size=3), quat=rng.normal(size=4))
        geoms.append(body.add_geom(type=kind, size=random_size(kind, rng) * 0.5))
    if num_meshes:
        geoms += add_triangles(spec, rng, num_meshes, is_open=light is None)
    for geom in geoms:
        geom.rgba = [1, 1, 1, 1] if light is not None else [*rng.uniform(0.2, 0.9, size=3), 1]
    if light is not None:
        above = rng.uniform([-1.0, -1.0, 1.2], [1.0, 1.0, 2.0])
        black, headlight = [0, 0, 0], spec.visual.headlight
        headlight.ambient, headlight.diffuse, headlight.specular = black, black, black
        world.add_light(type=light, pos=above, dir=-above, ambient=[1, 1, 1], diffuse=black, specular=black)
    eye = rng.normal(size=3)
    # Without a light, the camera may be inside a solid. With a light it must not be: shadows are undefined there.
    eye *= (rng.uniform(1.0, 2.0) if light is None else 2.5) / np.linalg.norm(eye)
    eye[2] = abs(eye[2])
    quaternion = look_at(eye, rng.uniform(-0.2, 0.2, size=3))
    world.add_camera(name="eye", pos=eye, quat=quaternion, fovy=rng.uniform(30.0, 70.0))
    return spec.compile()


def look_at(eye: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Returns f64[4], the quaternion of an upright camera at `eye` that looks at `target`, f64[3] m each."""
    backward = (eye - target) / np.linalg.norm(eye - target)
    right = np.cross([0.0, 0.0, 1.0], backward)
    right /= np.linalg.norm(right)
    matrix, quaternion = np.stack([right, np.cross(backward, right), backward], axis=1), np.zeros(4)
    mujoco.mju_mat2Quat(quaternion, np.ascontiguousarray(matrix).reshape(9))
    return quaternion


def forward(model: mujoco.MjModel) -> mujoco.MjData:
    """Returns the data of the model's initial state after mj_forward."""
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return data


def pixel_directions(model: mujoco.MjModel, data: mujoco.MjData, camera: int, size: tuple[int, int]) -> np.ndarray:
    """Returns f64[H, W, 3] in world, the rays through the pixels' centres, with length 1 along the optical axis."""
    height, width = size
    scale = 2.0 * np.tan(0.5 * np.deg2rad(model.cam_fovy[camera])) / height
    columns, rows = np.meshgrid(np.arange(width) + 0.5 - width / 2, np.arange(height) + 0.5 - height / 2)
    local = np.stack([scale * columns, -scale * rows, -np.ones_like(columns)], axis=-1)
    return local @ data.cam_xmat[camera].reshape(3, 3).T


def cast_image(
    model: mujoco.MjModel, data: mujoco.MjData, camera: int, size: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray]:
    """Returns mj_multiRay's depth f64[H, W] m (+inf on a miss) and geom id i32[H, W] (-1 on a miss)."""
    directions = pixel_directions(model, data, camera, size)
    count = size[0] * size[1]
    ids, distances = np.zeros(count, np.int32), np.zeros(count)
    origin = data.cam_xpos[camera]
    mujoco.mj_multiRay(
        model, data, origin, directions.reshape(-1), None, True, -1, ids, distances, None, count, mujoco.mjMAXVAL
    )
    return np.where(ids >= 0, distances, np.inf).reshape(size), ids.reshape(size)


def cast_points(
    model: mujoco.MjModel, data: mujoco.MjData, camera: int, size: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray]:
    """Returns the points that the pixels show, f64[H, W, 3] m in world (depth 1 on a miss), and the geom ids."""
    depth, ids = cast_image(model, data, camera, size)
    distances = np.where(np.isfinite(depth), depth, 1.0)[..., None]
    return data.cam_xpos[camera] + distances * pixel_directions(model, data, camera, size), ids


def on_outline(ids: np.ndarray) -> np.ndarray:
    """Returns bool[H, W]: one of the eight neighbours has another value."""
    padded = np.pad(ids, 1, mode="edge")
    height, width = ids.shape
    shifts = [(i, j) for i in range(3) for j in range(3)]
    return np.any([padded[i : i + height, j : j + width] != ids for i, j in shifts], axis=0)


def reached_by_light(
    model: mujoco.MjModel, data: mujoco.MjData, points: np.ndarray, ids: np.ndarray, far: float = 10.0
) -> np.ndarray:
    """Returns which points light 0 reaches, by mj_ray.

    mj_ray hits a plane from its front only, so each segment is tested in both directions.

    Args:
      model: compiled model.
      data: data of `model`.
      points: f64[H, W, 3] m, in world.
      ids: i32[H, W], geom of each point. Its body is ignored.
      far: distance in m at which a directional light is placed.

    Returns:
      bool[H, W].
    """
    is_directional = model.light_type[0] == mjtLightType.mjLIGHT_DIRECTIONAL
    is_reached = np.ones(ids.shape, dtype=bool)
    for pixel in np.ndindex(*ids.shape):
        to_light = -far * data.light_xdir[0] if is_directional else data.light_xpos[0] - points[pixel]
        body = model.geom_bodyid[ids[pixel]]
        outward = mujoco.mj_ray(model, data, points[pixel], to_light, None, True, body, None)
        inward = mujoco.mj_ray(model, data, points[pixel] + to_light, -to_light, None, True, body, None)
        is_reached[pixel] = not (0.0 <= outward < 1.0 or 0.0 <= inward < 1.0)
    return is_reached
