"""`render`: one image from what the other modules of this package do."""

from __future__ import annotations

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxlie import SO3

from vsearch_jax.render import shading, trace
from vsearch_jax.render.boundary import materialize, unknown_zero
from vsearch_jax.render.camera import pixel_rays
from vsearch_jax.render.rays import Vector, dot
from vsearch_jax.render.scene import RenderScene
from vsearch_jax.render.surface import level
from vsearch_jax.types import Camera, Image

# Height and width of the part of an image that is drawn at a time on a CPU: the some forty planes of a batch of such
# parts stay in its cache, and a part meets fewer geoms than the whole.
_CPU_TILE = (32, 64)


def render(scene: RenderScene, data: Any, camera: Camera, size: tuple[int, int]) -> Image:
    """Returns what `camera` sees.

    Depth and geom_id are those of C MuJoCo's `mj_ray` through the pixels' centres; colours follow MuJoCo's light model,
    evaluated in every pixel, with sharp shadows. There is no near or far plane. Light and camera belong outside of all
    solids: a wall seen from inside is lit as from outside, and shadows in there are not right. Derivatives are those of
    the geom that each pixel shows: finite, and blind to outlines and to the edges of shadows.

    Args:
      scene: RenderScene.
      data: mjx.Data, or anything with geom_xpos f32[ngeom, 3] m and geom_xmat f32[ngeom, 3, 3], geom to world.
      camera: Camera.
      size: height and width in pixels, static.

    Returns:
      Image of that size. What is not used of it costs nothing inside jit.
    """
    height, width = size
    # A GPU would rather have everything at once. A program exported to another platform is right there, if slower.
    tile = _CPU_TILE if jax.default_backend() == "cpu" else size
    tile_height, tile_width = min(tile[0], height), min(tile[1], width)
    rows, columns = -(-height // tile_height), -(-width // tile_width)
    frames = _frames(scene, data, camera)
    zero = unknown_zero(frames.origin)
    # Else the tangent and the products behind these would be computed anew in every pixel.
    frames, (x, y) = materialize((frames, pixel_rays(camera.fovy, size)), zero)
    x = jnp.pad(x, ((0, 0), (0, columns * tile_width - width)), mode="edge").reshape(columns, 1, tile_width)
    y = jnp.pad(y, ((0, rows * tile_height - height), (0, 0)), mode="edge").reshape(rows, tile_height, 1)
    rays = (jnp.tile(x, (rows, 1, 1)), jnp.repeat(y, columns, axis=0))
    tiles = jax.lax.map(functools.partial(_render_tile, scene, frames, camera, zero), rays)

    def join(planes: Array) -> Array:
        grid = planes.reshape(rows, columns, -1, tile_height, tile_width).transpose(0, 3, 1, 4, 2)
        return grid.reshape(rows * tile_height, columns * tile_width, -1)[:height, :width]

    return Image(rgb=join(tiles.rgb), depth=join(tiles.depth)[..., 0], geom_id=join(tiles.geom_id)[..., 0])


def silhouette(image: Image, geom_ids: tuple[int, ...]) -> Array:
    """Returns bool[H, W]: the pixel shows one of the geoms `geom_ids` (MuJoCo's numbers)."""
    ids = np.asarray(geom_ids, dtype=np.int32).reshape(-1)
    return jnp.any(image.geom_id[..., None] == ids[None, None], axis=-1)


def _render_tile(
    scene: RenderScene, frames: trace.Frames, camera: Camera, zero: Array, rays: tuple[Array, Array]
) -> Image:
    """Returns the image of the pixels with ray slopes `rays` (f32[1, w], f32[h, 1]); its rgb is f32[3, h, w]."""
    hits = trace.nearest(*jax.lax.stop_gradient((scene, frames, *rays)))
    depth, surface = _surface(scene, frames, hits, rays, zero)
    incidences = _incidences(scene, frames, camera, hits._replace(depth=depth), surface, rays)
    channels = shading.shade(scene, surface, materialize(incidences, zero))
    rgb = [jnp.where(hits.is_hit, channel, scene.background[i]) for i, channel in enumerate(channels)]
    geom_ids = jnp.asarray(scene.geom_ids, dtype=jnp.int32).at[hits.slot].get(mode="promise_in_bounds")
    return Image(
        rgb=jnp.stack(materialize(rgb, zero)),
        depth=jnp.where(hits.is_hit, depth, jnp.inf),
        geom_id=jnp.where(hits.is_hit, geom_ids, -1),
    )


def _incidences(
    scene: RenderScene,
    frames: trace.Frames,
    camera: Camera,
    hits: trace.Hits,
    surface: shading.Surface,
    rays: tuple[Array, Array],
) -> list[shading.Incidence]:
    """Returns how the scene's lights in their order, then the headlight, meet each pixel's surface."""
    view, incidences = _view(*rays), []
    for index, is_directional in enumerate(scene.lights.is_directional):
        position = camera.rotation.T @ (scene.lights.position[index] - camera.position)
        direction = camera.rotation.T @ scene.lights.direction[index]
        is_lit = jnp.ones((), dtype=jnp.float32)
        if scene.has_shadows and scene.lights.is_shadowing[index]:
            light = -direction if is_directional else position
            fixed = jax.lax.stop_gradient((scene, frames, hits, rays, light))
            is_lit = trace.is_lit(*fixed, is_directional)
        if is_directional:
            incidences.append(shading.directional_incidence(surface, view, -direction, is_lit))
        else:
            pose = (position, direction)
            incidences.append(shading.positional_incidence(surface, view, pose, scene.lights, index, is_lit))
    forward = jnp.array([0.0, 0.0, 1.0], dtype=jnp.float32)
    incidences.append(shading.directional_incidence(surface, view, forward, jnp.ones((), dtype=jnp.float32)))
    return incidences


def _frames(scene: RenderScene, data: Any, camera: Camera) -> trace.Frames:
    ids = np.asarray(scene.geom_ids)
    geom_rotation = data.geom_xmat.reshape(-1, 3, 3)[ids]
    offset = data.geom_xpos[ids] - camera.position[None]
    return trace.Frames(
        rotation=jnp.einsum("gji,jk->gik", geom_rotation, camera.rotation),
        origin=-jnp.einsum("gji,gj->gi", geom_rotation, offset),
        center=offset @ camera.rotation,
        radius=trace.bounding_radius(scene),
    )


def _look_up(table: Array, slot: Array) -> list[Array]:
    """Returns for each row of `table` [P, G] the entry of each pixel's geom, [H, W].

    One gather a row: XLA on CPU vectorises neither a long chain of selects nor a gather of whole rows.
    """
    return [row.at[slot].get(mode="promise_in_bounds") for row in table]


def _rotate(quaternion: tuple[Array, Array, Array, Array], vector: Vector) -> Vector:
    """Returns `vector` turned by a unit quaternion (w, x, y, z): v + 2 w (q x v) + 2 q x (q x v)."""
    w, qx, qy, qz = quaternion
    x, y, z = vector
    tx, ty, tz = 2.0 * (qy * z - qz * y), 2.0 * (qz * x - qx * z), 2.0 * (qx * y - qy * x)
    return x + w * tx + qy * tz - qz * ty, y + w * ty + qz * tx - qx * tz, z + w * tz + qx * ty - qy * tx


def _surface(
    scene: RenderScene, frames: trace.Frames, hits: trace.Hits, rays: tuple[Array, Array], zero: Array
) -> tuple[Array, shading.Surface]:
    """Returns the exact depth, f32[H, W], and the surface there.

    A Newton step from the rough depth makes it exact. The rough depth is a constant to differentiation, so that the
    step's derivative is the implicit function theorem's: depth and normal follow poses and sizes.
    """
    x, y = rays
    quaternion = jax.vmap(SO3.from_matrix)(frames.rotation).wxyz
    columns = [quaternion, frames.origin, scene.size, scene.rgb]
    columns += [v[:, None] for v in (scene.specular, scene.shininess, scene.emission)]
    rows = materialize(_look_up(materialize(jnp.concatenate(columns, axis=1).T, zero), hits.slot), zero)
    turn, origin, size = (rows[0], rows[1], rows[2], rows[3]), rows[4:7], (rows[7], rows[8], rows[9])
    direction = materialize(_rotate(turn, (x, y, -jnp.ones_like(x))), zero)
    starts = trace.type_starts(scene)

    def at(depth: Array) -> tuple[Array, Vector]:
        point = (origin[0] + depth * direction[0], origin[1] + depth * direction[1], origin[2] + depth * direction[2])
        return level(hits.slot, starts, size, point)

    value, outward = at(hits.depth)
    slope = dot(outward, direction)
    # Where the ray grazes, the step would be wild; the floor bounds it, far below any angle that a pixel resolves.
    floor = 1e-10 * dot(outward, outward) * dot(direction, direction) + 1e-30
    depth = materialize(hits.depth - value * slope / (slope * slope + floor), zero)
    outward = materialize(at(depth)[1], zero)
    away = jnp.where(dot(outward, direction) > 0.0, -1.0, 1.0)
    scale = materialize(away / jnp.sqrt(jnp.maximum(dot(outward, outward), 1e-20)), zero)
    w, qx, qy, qz = turn
    nx, ny, nz = _rotate((w, -qx, -qy, -qz), outward)
    normal = materialize((scale * nx, scale * ny, scale * nz), zero)
    point = (x * depth, y * depth, -depth)
    return depth, shading.Surface(point, normal, (rows[10], rows[11], rows[12]), rows[13], rows[14], rows[15])


def _view(x: Array, y: Array) -> Vector:
    inverse = 1.0 / jnp.sqrt(x * x + y * y + 1.0)
    return -x * inverse, -y * inverse, inverse
