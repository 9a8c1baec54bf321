"""The colour of the texture at each pixel.

First, each geom type has a function that returns MuJoCo's texture coordinates of a point (render_context.c, `makePlane`
and `makeBuiltin`). Then the texture is filtered as OpenGL's GL_LINEAR_MIPMAP_LINEAR does (OpenGL 2.1 specification,
section 3.8.8): bilinear within the two nearest mipmap levels, linear between them.

OpenGL knows how coordinates change across a pixel. Here that comes from differences between neighbouring pixels.
"""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import Array
from mujoco import mjtGeom

from vsearch_jax.render.geometry.level_sets import select
from vsearch_jax.render.texture.atlas import CUBE, MESH, NO_TEXTURE, PRIMITIVE, Textures
from vsearch_jax.xla.vectors import Vector

Coordinates = tuple[Array, Array]
"""Texture coordinates u and v, f32[H, W] each; the texture covers 0 to 1."""

# Lower bound of squared lengths and of divisors, so that gradients are finite.
_TINY = 1e-12


def _take(table: Array, index: Array) -> Array:
    return table.at[index].get(mode="promise_in_bounds")


def _turns(point: Vector) -> Array:
    """Returns the angle about z in turns, 0 to 1; 0 on the z axis."""
    is_axis = point[0] ** 2 + point[1] ** 2 < _TINY
    angle = jnp.arctan2(point[1], jnp.where(is_axis, 1.0, point[0])) / (2.0 * jnp.pi)
    return jnp.where(angle < 0.0, angle + 1.0, angle)


def _latitude(x: Array, y: Array, z: Array) -> Array:
    """Returns the angle above the plane z = 0 in right angles, -1 to 1."""
    radius = jnp.sqrt(jnp.maximum(x * x + y * y, _TINY))
    return jnp.arctan2(z, radius) / (0.5 * jnp.pi)


def _plane_coordinate(x: Array, half_size: Array) -> Array:
    """Returns 0 to 1 across a finite plane, and half the distance in m on an infinite one."""
    return jnp.where(half_size > 0.0, 0.5 + 0.5 * x / jnp.where(half_size > 0.0, half_size, 1.0), 0.5 * x)


def _plane(size: Vector, point: Vector) -> Coordinates:
    x, y = _plane_coordinate(point[0], size[0]), _plane_coordinate(point[1], size[1])
    return x, jnp.where(size[1] > 0.0, 1.0, 0.0) - y


def _box(size: Vector, point: Vector) -> Coordinates:
    x, y, z = (p / jnp.maximum(s, _TINY) for p, s in zip(point, size, strict=True))
    ax, ay, az = jnp.abs(x), jnp.abs(y), jnp.abs(z)
    is_x, is_y = (ax >= ay) & (ax >= az), ay >= az
    u, v = jnp.where(is_x, y, x), jnp.where(is_x | is_y, z, y)
    return 0.5 + 0.5 * u, 0.5 - 0.5 * v


def _ellipsoid(size: Vector, point: Vector) -> Coordinates:
    x, y, z = (p / jnp.maximum(s, _TINY) for p, s in zip(point, size, strict=True))
    return _turns((x, y, z)), 0.5 - 0.5 * _latitude(x, y, z)


def _sphere(size: Vector, point: Vector) -> Coordinates:
    return _turns(point), 0.5 - 0.5 * _latitude(*point)


def _cylinder(size: Vector, point: Vector) -> Coordinates:
    x, y, z = (p / jnp.maximum(s, _TINY) for p, s in zip(point, (size[0], size[0], size[1]), strict=True))
    is_cap = jnp.abs(z) > jnp.sqrt(jnp.maximum(x * x + y * y, _TINY))
    return jnp.where(is_cap, 0.5 + 0.5 * x, _turns(point)), jnp.where(is_cap, 0.5 + 0.5 * y, 0.5 - 0.5 * z)


def _capsule(size: Vector, point: Vector) -> Coordinates:
    beyond = jnp.abs(point[2]) - size[1]
    latitude = _latitude(point[0], point[1], beyond)
    cap = jnp.where(point[2] > 0.0, 1.0 - latitude, latitude)
    return _turns(point), jnp.where(beyond > 0.0, cap, 0.5 - 0.5 * point[2] / jnp.maximum(size[1], _TINY))


_COORDINATE_FUNCTIONS: dict[int, Callable[[Vector, Vector], Coordinates]] = {
    int(mjtGeom.mjGEOM_PLANE): _plane,
    int(mjtGeom.mjGEOM_SPHERE): _sphere,
    int(mjtGeom.mjGEOM_CAPSULE): _capsule,
    int(mjtGeom.mjGEOM_ELLIPSOID): _ellipsoid,
    int(mjtGeom.mjGEOM_CYLINDER): _cylinder,
    int(mjtGeom.mjGEOM_BOX): _box,
}
"""By mjtGeom: `(size, point) -> (u, v)`, with `size` and `point` in the geom's frame, in m."""


def _cube_map(direction: Vector) -> tuple[Coordinates, Array]:
    """Returns the coordinates and the side of a cube map in a direction (OpenGL 2.1 specification, section 3.8.6)."""
    x, y, z = direction
    ax, ay, az = jnp.abs(x), jnp.abs(y), jnp.abs(z)
    is_x, is_y = (ax >= ay) & (ax >= az), ay >= az
    u = jnp.where(is_x, -jnp.sign(x) * z, jnp.where(is_y, x, jnp.sign(z) * x))
    v = jnp.where(is_x, -y, jnp.where(is_y, jnp.sign(y) * z, -y))
    major = jnp.maximum(jnp.where(is_x, ax, jnp.where(is_y, ay, az)), _TINY)
    signed = jnp.where(is_x, x, jnp.where(is_y, y, z))
    side = jnp.where(is_x, 0, jnp.where(is_y, 2, 4)) + jnp.where(signed < 0.0, 1, 0)
    return (0.5 + 0.5 * u / major, 0.5 + 0.5 * v / major), side.astype(jnp.int32)


def _pixel_steps(value: Array) -> list[Array]:
    """Returns the change of `value` from pixel to pixel, first along the image's vertical axis, then along the other.

    Of the differences with the two neighbours along an axis, the smaller one counts. So at an outline, the neighbour on
    the pixel's own side counts. Along an axis of one pixel the change is 0.
    """
    result = []
    for axis in (0, 1):
        difference = jnp.abs(jnp.diff(value, axis=axis))
        pad = [(0, 0), (0, 0)]
        pad[axis] = (0, 1)
        forward = jnp.pad(difference, pad, constant_values=jnp.inf)
        pad[axis] = (1, 0)
        smaller = jnp.minimum(forward, jnp.pad(difference, pad, constant_values=jnp.inf))
        result.append(jnp.where(jnp.isfinite(smaller), smaller, 0.0))
    return result


def _unpack_texel(textures: Textures, index: Array) -> Vector:
    """Returns red, green and blue of a texel, in [0, 1]."""
    packed = _take(textures.texels, index)
    red, green, blue = ((packed >> shift & 0xFF).astype(jnp.float32) / 255.0 for shift in (0, 8, 16))
    return red, green, blue


def _linear_weights(coordinate: Array, count: Array, is_cube: Array) -> list[tuple[Array, Array]]:
    """Returns the indices of the two texels around a coordinate along one axis, each with its weight.

    A 2D texture repeats. A side of a cube map is clamped at its edges.
    """
    position = coordinate * count.astype(jnp.float32) - 0.5
    first = jax.lax.stop_gradient(jnp.floor(position))
    fraction, result = position - first, []
    for step, weight in ((0, 1.0 - fraction), (1, fraction)):
        index = first.astype(jnp.int32) + step
        result.append((jnp.where(is_cube, jnp.clip(index, 0, count - 1), jnp.remainder(index, count)), weight))
    return result


def _bilinear(textures: Textures, image: tuple[Array, Array, Array], uv: Coordinates, is_cube: Array) -> Vector:
    """Returns the bilinear mean of four texels. `image` holds texture, side and mipmap level, i32[H, W] each."""
    texture, side, level = image
    start = _take(textures.start, (texture * 6 + side) * textures.num_levels + level)
    width, height = (
        jnp.maximum(_take(count, texture).astype(jnp.int32) >> level, 1) for count in (textures.width, textures.height)
    )
    total = [jnp.zeros_like(uv[0])] * 3
    for row, weight_v in _linear_weights(uv[1], height, is_cube):
        for column, weight_u in _linear_weights(uv[0], width, is_cube):
            texel = _unpack_texel(textures, start + row * width + column)
            total = [t + weight_u * weight_v * c for t, c in zip(total, texel, strict=True)]
    return total[0], total[1], total[2]


def _trilinear(textures: Textures, texture: Array, side: Array, uv: Coordinates, is_cube: Array) -> Vector:
    """Returns the trilinear mean: linear between the bilinear means of the two nearest mipmap levels."""
    counts = (_take(textures.width, texture), _take(textures.height, texture))
    steps = [_pixel_steps(jax.lax.stop_gradient(c * n)) for c, n in zip(uv, counts, strict=True)]
    squared = jnp.maximum(steps[0][0] ** 2 + steps[1][0] ** 2, steps[0][1] ** 2 + steps[1][1] ** 2)
    last_level = jnp.floor(jnp.log2(jnp.maximum(counts[0], counts[1])))
    # The logarithm of the number of texels that one pixel spans; half of it, since the number is squared.
    level = jnp.clip(0.5 * jnp.log2(jnp.maximum(squared, 1.0)), 0.0, last_level)
    first = jnp.floor(level)
    fine, coarse = first.astype(jnp.int32), jnp.minimum(first + 1.0, last_level).astype(jnp.int32)
    a = _bilinear(textures, (texture, side, fine), uv, is_cube)
    b = _bilinear(textures, (texture, side, coarse), uv, is_cube)
    red, green, blue = (p + (level - first) * (q - p) for p, q in zip(a, b, strict=True))
    return red, green, blue


def colour(
    textures: Textures,
    slot: Array,
    starts: tuple[tuple[int, int], ...],
    local: tuple[Vector, Vector],
    texcoord: Coordinates | None,
) -> Vector:
    """Computes the texture's colour at the surface point that each pixel of an H x W image shows.

    Args:
      textures: all textures of the scene.
      slot: i32[H, W], row of each pixel's geom in the scene.
      starts: (mjtGeom, first row) of each geom type in the scene, sorted by row. Static.
      local: size of each pixel's geom (`geom_size`), and the point in the geom's frame; three f32[H, W] m each.
      texcoord: texture coordinates u and v at pixels that show a mesh, f32[H, W] each. None if no mesh has any.

    Returns:
      Red, green and blue in [0, 1], f32[H, W] each; 1 for geoms without a texture.
    """
    size, point = local
    mode = _take(jnp.asarray(textures.modes, dtype=jnp.int32), slot)
    texture = _take(textures.texture, slot)
    u, v, side = point[0], point[1], jnp.zeros_like(slot)
    if PRIMITIVE in textures.modes:
        for kind, start in starts:
            of_kind = _COORDINATE_FUNCTIONS[kind](size, point)
            is_kind = (slot >= start) & (mode == PRIMITIVE)
            u, v = (jnp.where(is_kind, b, a) for a, b in zip((u, v), of_kind, strict=True))
    if MESH in textures.modes and texcoord is not None:
        u, v = (jnp.where(mode == MESH, b, a) for a, b in zip((u, v), texcoord, strict=True))
    (su, sv), (tu, tv) = ([_take(row, slot) for row in table] for table in (textures.scale, textures.shift))
    u, v = u * su + tu, v * sv + tv
    if CUBE in textures.modes:
        direction = [p / _take(row, slot) for p, row in zip(point, textures.extent, strict=True)]
        (cube_u, cube_v), cube_side = _cube_map((direction[0], direction[1], direction[2]))
        u, v = jnp.where(mode == CUBE, cube_u, u), jnp.where(mode == CUBE, cube_v, v)
        side = jnp.where(mode == CUBE, cube_side, side)
    one = jnp.ones_like(u)
    rgb = _trilinear(textures, texture, side, (u, v), mode == CUBE)
    return select(mode != NO_TEXTURE, (one, rgb), (one, (one, one, one)))[1]


def sky(textures: Textures, direction: Vector) -> Vector:
    """Computes the colour of the skybox for each pixel of an H x W image.

    Args:
      textures: all textures of the scene, with a skybox.
      direction: three f32[H, W], direction of each pixel's ray in world, of any length but 0. The y axis of the skybox
        is the world's z axis.

    Returns:
      Red, green and blue in [0, 1], f32[H, W] each.
    """
    assert textures.sky is not None
    uv, side = _cube_map((direction[0], direction[2], -direction[1]))
    texture = jnp.full_like(side, textures.sky)
    return _trilinear(textures, texture, side, uv, jnp.ones_like(side, dtype=bool))
