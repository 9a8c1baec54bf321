"""Test scenes, and the renderer and its peers as functions that render one batch of a scene."""

from __future__ import annotations

import copy
import dataclasses
import os
import queue
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import trimesh

import vsearch_jax as vs
from vsearch_jax import geometry, render
from vsearch_jax.types import Camera, View

FOVY = 0.8  # rad, vertical field of view of all cameras

Planes = tuple[jax.Array, jax.Array, jax.Array]
"""Colour, depth and geom ids of a batch."""


@dataclasses.dataclass(frozen=True)
class Case:
    """A model in its initial state, and a batch of B cameras around it.

    Attributes:
      model: the compiled scene.
      data: initial state of `model` after mj_forward.
      positions: f64[B, 3] m, of the cameras in world.
      rotations: f64[B, 3, 3], camera to world.
    """

    model: mujoco.MjModel
    data: mujoco.MjData
    positions: np.ndarray
    rotations: np.ndarray


def mesh_case(num_faces: int, batch: int, has_lamp: bool = False) -> Case:
    """Returns a scene with one bumpy ball that covers a quarter of a square image.

    Args:
      num_faces: approximate number of faces.
      batch: number of cameras.
      has_lamp: whether there is a light besides the headlight. The ball then casts shadows on itself.
    """
    count = round((num_faces / 8) ** 0.5) + 1  # trimesh's sphere has about 8 count^2 faces
    ball = trimesh.creation.uv_sphere(radius=1.0, count=[count, 2 * count])
    x, y, z = ball.vertices.T
    vertices = ball.vertices * (0.1 * (1.0 + 0.1 * np.sin(7.0 * x) * np.cos(5.0 * y + 3.0 * z)))[:, None]
    spec = mujoco.MjSpec()
    spec.add_mesh(name="ball", uservert=vertices.reshape(-1), userface=ball.faces.reshape(-1))
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname="ball", rgba=[0.8, 0.5, 0.3, 1.0])
    if has_lamp:
        spec.worldbody.add_light(
            pos=[0.5, 0.3, 1.0], dir=[-0.5, -0.3, -1.0], type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL
        )
    # A disc that covers a quarter of a square has a radius of 0.28 of the square's edge.
    return _compile_case(spec, np.zeros(3), 0.1 / (2 * 0.28 * np.tan(FOVY / 2)), batch)


def project_case(batch: int) -> Case:
    """Returns the project's scene: arm, table and the object of the preset `cpu`, with `batch` cameras."""
    scene = vs.build_scene(vs.Config.preset("cpu").scene)
    return _case_with_cameras(scene.mj_model, np.asarray(scene.center), scene.radius, batch)


def workshop_case() -> Case:
    """Returns the scene in examples/ with its one camera: a mesh, a height field, textures, a spot light."""
    model = mujoco.MjModel.from_xml_path(str(Path(__file__).resolve().parents[2] / "examples" / "workshop.xml"))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    eye = model.camera("room").id
    return Case(model, data, data.cam_xpos[eye][None], data.cam_xmat[eye].reshape(1, 3, 3))


def _compile_case(spec: mujoco.MjSpec, center: np.ndarray, distance: float, batch: int) -> Case:
    spec.visual.global_.offwidth = spec.visual.global_.offheight = 512
    return _case_with_cameras(spec.compile(), center, distance, batch)


def _case_with_cameras(model: mujoco.MjModel, center: np.ndarray, distance: float, batch: int) -> Case:
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    positions, rotations = [], []
    for index in range(batch):
        pose = geometry.view_pose(View(jnp.float32(2.4 * index), jnp.float32(0.5)), jnp.asarray(center), distance)
        positions.append(np.asarray(pose.translation(), np.float64))
        rotations.append(np.asarray(pose.rotation().as_matrix(), np.float64))
    return Case(model, data, np.stack(positions), np.stack(rotations))


def _directions(case: Case, size: int) -> np.ndarray:
    """Returns f64[B, size^2, 3], rays in world with length 1 along the optical axis."""
    slopes = (np.arange(size) - 0.5 * (size - 1)) * 2.0 * np.tan(FOVY / 2) / size
    columns, rows = np.meshgrid(slopes, -slopes)
    local = np.stack([columns, rows, -np.ones_like(rows)], axis=-1).reshape(-1, 3)
    return np.einsum("bij,pj->bpi", case.rotations, local)


def program(case: Case, size: int, has_shadows: bool) -> tuple[jax.stages.Wrapped, tuple[jax.Array, jax.Array]]:
    """Returns the jitted function that renders the batch, and its arguments: positions and rotations of the cameras.

    Args:
      case: the scene and its cameras.
      size: edge of an image in pixels.
      has_shadows: whether lights cast shadows.
    """
    scene = dataclasses.replace(render.compile_scene(case.model), has_shadows=has_shadows)
    data = render.poses(case.data)

    def render_one(position: jax.Array, rotation: jax.Array) -> Planes:
        image = render.render(scene, data, Camera(position, rotation, jnp.float32(FOVY)), (size, size))
        return image.rgb, image.depth, image.geom_id

    arguments = (jnp.asarray(case.positions, jnp.float32), jnp.asarray(case.rotations, jnp.float32))
    return jax.jit(jax.vmap(render_one)), arguments


def ours(case: Case, size: int, has_shadows: bool) -> Callable[[], Planes]:
    """Returns a function that renders the whole batch in one program and waits for the result.

    Args:
      case: the scene and its cameras.
      size: edge of an image in pixels.
      has_shadows: whether lights cast shadows.
    """
    draw, arguments = program(case, size, has_shadows)
    return lambda: jax.block_until_ready(draw(*arguments))


def compile_cost(case: Case, size: int, has_shadows: bool) -> tuple[float, float]:
    """Returns the time in s to trace and compile the program, and its memory in MiB per image.

    Args:
      case: the scene and its cameras.
      size: edge of an image in pixels.
      has_shadows: whether lights cast shadows.
    """
    draw, arguments = program(case, size, has_shadows)
    start = time.perf_counter()
    compiled = draw.lower(*arguments).compile()
    seconds = time.perf_counter() - start
    memory = compiled.memory_analysis()
    assert memory is not None
    return seconds, (memory.temp_size_in_bytes + memory.output_size_in_bytes) / 2**20 / len(case.positions)


def multi_ray(case: Case, size: int) -> Callable[[], object]:
    """Returns a function that casts the batch's rays with mj_multiRay on all cores: depth and geom ids only.

    Args:
      case: the scene and its cameras.
      size: edge of an image in pixels.
    """
    directions, count = _directions(case, size), size * size
    pool = ThreadPoolExecutor(os.cpu_count())

    # mj_multiRay writes to the stack of its MjData, so each thread needs one of its own.
    free: queue.SimpleQueue[mujoco.MjData] = queue.SimpleQueue()
    for _ in range(os.cpu_count() or 1):
        free.put(copy.copy(case.data))

    def cast_one(index: int) -> tuple[np.ndarray, np.ndarray]:
        ids, distances = np.zeros(count, np.int32), np.zeros(count)
        origin, rays = case.positions[index], directions[index].reshape(-1)
        args = (origin, rays, None, True, -1, ids, distances, None, count, mujoco.mjMAXVAL)
        data = free.get()
        mujoco.mj_multiRay(case.model, data, *args)  # releases the GIL
        free.put(data)
        return ids, distances

    return lambda: list(pool.map(cast_one, range(len(directions))))


def opengl(case: Case, size: int) -> Callable[[], list[np.ndarray]]:
    """Returns a function that renders the batch's colours with mujoco.Renderer, one image after another.

    Args:
      case: the scene and its cameras.
      size: edge of an image in pixels.

    Raises:
      Exception: there is no OpenGL on this machine. The type depends on the library.
    """
    renderer = mujoco.Renderer(case.model, size, size)
    camera = mujoco.MjvCamera()
    # Our renderer does not draw these effects.
    for flag in (mujoco.mjtRndFlag.mjRND_HAZE, mujoco.mjtRndFlag.mjRND_REFLECTION):
        renderer.scene.flags[flag] = 0

    def render_one(index: int) -> np.ndarray:
        renderer.update_scene(case.data, camera)
        position, forward, up = case.positions[index], *(case.rotations[index].T[[2, 1]] * [[-1.0], [1.0]])
        for light in renderer.scene.lights[: renderer.scene.nlight]:
            if light.headlight:
                light.pos, light.dir = position, forward
        for eye in renderer.scene.camera:
            eye.pos, eye.forward, eye.up = position, forward, up
            half = np.tan(FOVY / 2) * eye.frustum_near
            eye.frustum_bottom, eye.frustum_top, eye.frustum_center = -half, half, 0.0
            eye.frustum_width = half
        return renderer.render()

    return lambda: [render_one(index) for index in range(len(case.positions))]


def embree(case: Case, size: int) -> Callable[[], object]:
    """Returns a function that casts the batch's rays with embree on one core. The model must have one mesh only.

    Args:
      case: the scene and its cameras.
      size: edge of an image in pixels.

    Raises:
      ImportError: embreex is not installed. The extra `benchmark` has it.
    """
    from trimesh.ray.ray_pyembree import RayMeshIntersector

    mesh = trimesh.Trimesh(case.model.mesh_vert, case.model.mesh_face, process=False)
    rotation = case.data.geom_xmat[0].reshape(3, 3)
    intersector = RayMeshIntersector(mesh)
    rays = (_directions(case, size) @ rotation).astype(np.float32)
    origins = ((case.positions - case.data.geom_xpos[0]) @ rotation).astype(np.float32)

    def cast_one(index: int) -> np.ndarray:
        return intersector.intersects_first(np.broadcast_to(origins[index], rays[index].shape), rays[index])

    return lambda: [cast_one(index) for index in range(len(rays))]
