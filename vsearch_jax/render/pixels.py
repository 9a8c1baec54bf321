"""What each pixel shows, from the geom or face that its ray meets."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import Array
from jaxlie import SO3

from vsearch_jax.render import trace
from vsearch_jax.render.geometry.level_sets import affine, level, select
from vsearch_jax.render.light.shading import Surface
from vsearch_jax.render.scene import RenderScene
from vsearch_jax.render.texture import lookup
from vsearch_jax.xla.materialize import materialize
from vsearch_jax.xla.vectors import Vector, dot


def look_up(table: Array | list[Array], index: Array) -> list[Array]:
    """Returns for each row of `table` [P, N] the entry of each pixel's `index`, [H, W].

    One gather a row: XLA on CPU vectorises neither a long chain of selects nor a gather of whole rows.
    """
    return [row.at[index].get(mode="promise_in_bounds") for row in table]


def _rotate(quaternion: tuple[Array, Array, Array, Array], vector: Vector) -> Vector:
    """Returns `vector` turned by a unit quaternion (w, x, y, z): v + 2 w (q x v) + 2 q x (q x v)."""
    w, qx, qy, qz = quaternion
    x, y, z = vector
    tx, ty, tz = 2.0 * (qy * z - qz * y), 2.0 * (qz * x - qx * z), 2.0 * (qx * y - qy * x)
    return x + w * tx + qy * tz - qz * ty, y + w * ty + qz * tx - qx * tz, z + w * tz + qx * ty - qy * tx


def _geom_rows(scene: RenderScene, frames: trace.Frames, slot: Array, zero: Array) -> list[Array]:
    """Returns each pixel's geom: rotation (4), origin (3), size (3), colour (3), specular, shininess, emission."""
    quaternion = jax.vmap(SO3.from_matrix)(frames.rotation).wxyz
    placed = materialize(jnp.concatenate([quaternion, frames.origin], axis=1).T, zero)
    # Apart from the poses: a table that all images of a batch share is looked up in half the time.
    worn = [*scene.size.T, *scene.rgb.T, scene.specular, scene.shininess, scene.emission]
    if len(scene.geom_ids) == 1:  # nothing to look up
        return [jnp.broadcast_to(row[0], slot.shape) for row in (*placed, *worn)]
    return materialize(look_up(placed, slot) + look_up(worn, slot), zero)


def surface_of(
    scene: RenderScene, frames: trace.Frames, hits: trace.Hits, rays: tuple[Array, Array], zero: Array
) -> tuple[Array, Surface]:
    """Returns the exact depth, f32[H, W], and the surface there.

    A Newton step from the rough depth makes it exact. The rough depth is a constant to differentiation, so that the
    step's derivative is the implicit function theorem's: depth and normal follow poses and sizes.
    """
    x, y = rays
    rows = _geom_rows(scene, frames, hits.slot, zero)
    turn, origin, size = (rows[0], rows[1], rows[2], rows[3]), rows[4:7], (rows[7], rows[8], rows[9])
    direction = materialize(_rotate(turn, (x, y, -jnp.ones_like(x))), zero)
    starts, is_face = trace.type_starts(scene), hits.slot >= scene.num_primitives
    faces = None
    if scene.triangles is not None:
        count = 24 if any(scene.triangles.has_texcoord) else 16
        faces = materialize(look_up(scene.triangles.surface[:count], hits.face), zero)

    def at(depth: Array) -> tuple[Array, Vector, Vector]:
        point = (origin[0] + depth * direction[0], origin[1] + depth * direction[1], origin[2] + depth * direction[2])
        value, outward = level(hits.slot, starts, size, point)
        if faces is not None:
            flat = (faces[0], faces[1], faces[2])
            value, outward = select(is_face, (dot(flat, point) - faces[3], flat), (value, outward))
        return value, outward, point

    value, outward, _ = at(hits.depth)
    slope = dot(outward, direction)
    # Where the ray grazes, the step would be wild; the floor bounds it, far below any angle that a pixel resolves.
    floor = 1e-10 * dot(outward, outward) * dot(direction, direction) + 1e-30
    depth = materialize(hits.depth - value * slope / (slope * slope + floor), zero)
    _, outward, local = at(depth)
    # The face, not its smooth normal, tells which side is seen.
    outward = materialize(outward, zero)
    away = jnp.where(dot(outward, direction) > 0.0, -1.0, 1.0)
    flat = normal = _turned_back(turn, outward, away, zero)
    if faces is not None:
        smooth = affine(faces[4:16], local)
        _, outward = select(is_face, (depth, (smooth[0], smooth[1], smooth[2])), (depth, outward))
        normal = _turned_back(turn, materialize(outward, zero), away, zero)
    point, rgb, tint = (x * depth, y * depth, -depth), (rows[10], rows[11], rows[12]), None
    if scene.textures is not None:
        texcoord = None
        if faces is not None and len(faces) == 24:
            u, v = affine(faces[16:24], local)
            texcoord = (u, v)
        local = materialize(local, zero)
        tint = lookup.colour(scene.textures, hits.slot, starts, (size, local), texcoord)
        tint = materialize(tint, zero)
    return depth, Surface(point, normal, flat, rgb, rows[13], rows[14], rows[15], tint)


def _turned_back(turn: tuple[Array, Array, Array, Array], outward: Vector, away: Array, zero: Array) -> Vector:
    """Returns in the camera's frame the unit vector along `away` times `outward` of the geom's frame."""
    scale = materialize(away / jnp.sqrt(jnp.maximum(dot(outward, outward), 1e-20)), zero)
    w, qx, qy, qz = turn
    x, y, z = _rotate((w, -qx, -qy, -qz), outward)
    return materialize((scale * x, scale * y, scale * z), zero)
