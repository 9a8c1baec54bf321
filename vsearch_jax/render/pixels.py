"""Computes what each pixel shows: exact depth, normal, material and texture at its hit."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import Array
from jaxlie import SO3

from vsearch_jax.render import trace
from vsearch_jax.render.geometry.level_sets import affine, level, select
from vsearch_jax.render.geometry.triangles import NUM_ROWS
from vsearch_jax.render.light.shading import Surface
from vsearch_jax.render.scene import RenderScene
from vsearch_jax.render.texture import lookup
from vsearch_jax.xla.materialize import materialize
from vsearch_jax.xla.vectors import Vector, dot

_Quaternion = tuple[Array, Array, Array, Array]
"""w, x, y and z."""


def _look_up(table: Array | list[Array], index: Array) -> list[Array]:
    """Returns for each row of `table` [P, N] the entries at `index` [H, W].

    There is one gather for each row. XLA on CPU vectorises neither a long chain of selects nor a gather of whole rows.
    """
    return [row.at[index].get(mode="promise_in_bounds") for row in table]


def _rotate(quaternion: _Quaternion, vector: Vector) -> Vector:
    """Returns `vector` v rotated by a unit quaternion (w, q): v + 2 w (q x v) + 2 q x (q x v)."""
    w, qx, qy, qz = quaternion
    x, y, z = vector
    tx, ty, tz = 2.0 * (qy * z - qz * y), 2.0 * (qz * x - qx * z), 2.0 * (qx * y - qy * x)
    return x + w * tx + qy * tz - qz * ty, y + w * ty + qz * tx - qx * tz, z + w * tz + qx * ty - qy * tx


def _geom_rows(scene: RenderScene, frames: trace.Frames, slot: Array, zero: Array) -> list[Array]:
    """Returns 16 rows for each pixel's geom.

    They are: rotation camera to geom (4, a quaternion), origin (3), size (3), rgb (3), specular, shininess, emission.
    """
    quaternion = jax.vmap(SO3.from_matrix)(frames.rotation).wxyz
    poses = materialize(jnp.concatenate([quaternion, frames.origin], axis=1).T, zero)
    # A table of its own: all images of a batch share it, and a gather from a shared table takes half the time.
    materials = [*scene.size.T, *scene.rgb.T, scene.specular, scene.shininess, scene.emission]
    if len(scene.geom_ids) == 1:
        return [jnp.broadcast_to(row[0], slot.shape) for row in (*poses, *materials)]
    return materialize(_look_up(poses, slot) + _look_up(materials, slot), zero)


def resolve_surface(
    scene: RenderScene, frames: trace.Frames, hits: trace.Hits, rays: tuple[Array, Array], zero: Array
) -> tuple[Array, Surface]:
    """Computes the exact depth of each pixel of an H x W image, and the surface (point, normal, colour) that it shows.

    One Newton step from the rough depth makes the depth exact. The rough depth is a constant to differentiation. The
    derivative of the step is then that of the implicit function theorem: depth and normal follow poses and sizes.

    Args:
      scene: shapes and materials of the geoms.
      frames: poses of the geoms relative to the camera.
      hits: geom that each pixel shows, with a rough depth.
      rays: x f32[1, W] and y f32[H, 1] of the directions (x, y, -1) of the pixels' rays, in the camera's frame.
      zero: i32[], a 0 that the compiler does not know to be 0. It keeps XLA from computing results twice.

    Returns:
      Depth f32[H, W] m along the optical axis, and the surface in the camera's frame. Where a pixel shows no geom, the
      values have no meaning.
    """
    x, y = rays
    rows = _geom_rows(scene, frames, hits.slot, zero)
    quaternion, origin, size = (rows[0], rows[1], rows[2], rows[3]), rows[4:7], (rows[7], rows[8], rows[9])
    direction = materialize(_rotate(quaternion, (x, y, -jnp.ones_like(x))), zero)
    starts, is_face = trace.type_starts(scene), hits.slot >= scene.num_primitives
    faces = _face_rows(scene, hits, zero)

    def level_at(depth: Array) -> tuple[Array, Vector, Vector]:
        """Returns the level function, its gradient, and the point on the ray, in the geom's frame."""
        point = (origin[0] + depth * direction[0], origin[1] + depth * direction[1], origin[2] + depth * direction[2])
        value, outward = level(hits.slot, starts, size, point)
        if faces is not None:
            flat = (faces[0], faces[1], faces[2])
            value, outward = select(is_face, (dot(flat, point) - faces[3], flat), (value, outward))
        return value, outward, point

    value, outward, _ = level_at(hits.depth)
    depth = materialize(hits.depth - _newton_step(value, outward, direction), zero)
    _, outward, local = level_at(depth)
    # The face decides which side is visible. Its smooth normal may point away.
    outward = materialize(outward, zero)
    side = jnp.where(dot(outward, direction) > 0.0, -1.0, 1.0)
    flat = normal = _normal_in_camera(quaternion, outward, side, zero)
    if faces is not None:
        smooth = affine(faces[4:16], local)
        _, outward = select(is_face, (depth, (smooth[0], smooth[1], smooth[2])), (depth, outward))
        normal = _normal_in_camera(quaternion, materialize(outward, zero), side, zero)
    point, rgb = (x * depth, y * depth, -depth), (rows[10], rows[11], rows[12])
    tint = _texture_tint(scene, hits, faces, (size, local), zero)
    return depth, Surface(point, normal, flat, rgb, rows[13], rows[14], rows[15], tint)


def _newton_step(value: Array, outward: Vector, direction: Vector) -> Array:
    """Returns the error of the depth; `value` and `outward` are the level function and its gradient."""
    slope = dot(outward, direction)
    # For a grazing ray, the slope is near 0 and the step would be too large. The floor bounds the step. It corresponds
    # to an angle far below the resolution of a pixel.
    floor = 1e-10 * dot(outward, outward) * dot(direction, direction) + 1e-30
    return value * slope / (slope * slope + floor)


def _face_rows(scene: RenderScene, hits: trace.Hits, zero: Array) -> list[Array] | None:
    """Returns the rows of `Triangles.surface` for each pixel's face, or None without triangles."""
    if scene.triangles is None:
        return None
    return materialize(_look_up(scene.triangles.surface, hits.face), zero)


def _texture_tint(
    scene: RenderScene, hits: trace.Hits, faces: list[Array] | None, local: tuple[Vector, Vector], zero: Array
) -> Vector | None:
    """Returns the texture's factor of each pixel's colour; `local` is the geom's size and the point in its frame."""
    if scene.textures is None:
        return None
    size, point = local
    texcoord = None
    if faces is not None and len(faces) == NUM_ROWS:
        u, v = affine(faces[16:24], point)
        texcoord = (u, v)
    point = materialize(point, zero)
    tint = lookup.colour(scene.textures, hits.slot, trace.type_starts(scene), (size, point), texcoord)
    return materialize(tint, zero)


def _normal_in_camera(quaternion: _Quaternion, outward: Vector, side: Array, zero: Array) -> Vector:
    """Returns the unit vector along `side` * `outward`, rotated from the geom's to the camera's frame."""
    scale = materialize(side / jnp.sqrt(jnp.maximum(dot(outward, outward), 1e-20)), zero)
    w, qx, qy, qz = quaternion
    x, y, z = _rotate((w, -qx, -qy, -qz), outward)
    return materialize((scale * x, scale * y, scale * z), zero)
