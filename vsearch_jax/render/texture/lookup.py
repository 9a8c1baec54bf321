"""The texture's colour in each pixel: MuJoCo's coordinates, OpenGL's trilinear filter."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import Array
from mujoco import mjtGeom

from vsearch_jax.render.geometry.level_sets import select
from vsearch_jax.render.texture.atlas import CUBE, FACES, PLAIN, PRIMITIVE, Textures
from vsearch_jax.xla.vectors import Vector

Coordinates = tuple[Array, Array]

# Keeps the gradient of a direction finite where it has no length.
_TINY = 1e-12


def _take(table: Array, index: Array) -> Array:
    return table.at[index].get(mode="promise_in_bounds")


def _turn(point: Vector) -> Array:
    """Returns the angle around z, from 0 to 1."""
    is_axis = point[0] ** 2 + point[1] ** 2 < _TINY
    angle = jnp.arctan2(point[1], jnp.where(is_axis, 1.0, point[0])) / (2.0 * jnp.pi)
    return jnp.where(angle < 0.0, angle + 1.0, angle)


def _latitude(x: Array, y: Array, z: Array) -> Array:
    """Returns the angle above the plane z = 0, in units of a right angle."""
    radius = jnp.sqrt(jnp.maximum(x * x + y * y, _TINY))
    return jnp.arctan2(z, radius) / (0.5 * jnp.pi)


def _across(place: Array, size: Array) -> Array:
    return jnp.where(size > 0.0, 0.5 + 0.5 * place / jnp.where(size > 0.0, size, 1.0), 0.5 * place)


def _plane(size: Vector, point: Vector) -> Coordinates:
    x, y = _across(point[0], size[0]), _across(point[1], size[1])
    return x, jnp.where(size[1] > 0.0, 1.0, 0.0) - y


def _box(size: Vector, point: Vector) -> Coordinates:
    x, y, z = (p / jnp.maximum(s, _TINY) for p, s in zip(point, size, strict=True))
    ax, ay, az = jnp.abs(x), jnp.abs(y), jnp.abs(z)
    is_x, is_y = (ax >= ay) & (ax >= az), ay >= az
    u, v = jnp.where(is_x, y, x), jnp.where(is_x | is_y, z, y)
    return 0.5 + 0.5 * u, 0.5 - 0.5 * v


def _ellipsoid(size: Vector, point: Vector) -> Coordinates:
    x, y, z = (p / jnp.maximum(s, _TINY) for p, s in zip(point, size, strict=True))
    return _turn((x, y, z)), 0.5 - 0.5 * _latitude(x, y, z)


def _sphere(size: Vector, point: Vector) -> Coordinates:
    return _turn(point), 0.5 - 0.5 * _latitude(*point)


def _cylinder(size: Vector, point: Vector) -> Coordinates:
    x, y, z = (p / jnp.maximum(s, _TINY) for p, s in zip(point, (size[0], size[0], size[1]), strict=True))
    is_cap = jnp.abs(z) > jnp.sqrt(jnp.maximum(x * x + y * y, _TINY))
    return jnp.where(is_cap, 0.5 + 0.5 * x, _turn(point)), jnp.where(is_cap, 0.5 + 0.5 * y, 0.5 - 0.5 * z)


def _capsule(size: Vector, point: Vector) -> Coordinates:
    beyond = jnp.abs(point[2]) - size[1]
    latitude = _latitude(point[0], point[1], beyond)
    cap = jnp.where(point[2] > 0.0, 1.0 - latitude, latitude)
    return _turn(point), jnp.where(beyond > 0.0, cap, 0.5 - 0.5 * point[2] / jnp.maximum(size[1], _TINY))


_COORDINATES: dict[int, Callable[[Vector, Vector], Coordinates]] = {
    int(mjtGeom.mjGEOM_PLANE): _plane,
    int(mjtGeom.mjGEOM_SPHERE): _sphere,
    int(mjtGeom.mjGEOM_CAPSULE): _capsule,
    int(mjtGeom.mjGEOM_ELLIPSOID): _ellipsoid,
    int(mjtGeom.mjGEOM_CYLINDER): _cylinder,
    int(mjtGeom.mjGEOM_BOX): _box,
}


def _cube(way: Vector) -> tuple[Coordinates, Array]:
    """Returns where on which side of a cube a direction points (OpenGL 2.1 specification, 3.8.6)."""
    x, y, z = way
    ax, ay, az = jnp.abs(x), jnp.abs(y), jnp.abs(z)
    is_x, is_y = (ax >= ay) & (ax >= az), ay >= az
    u = jnp.where(is_x, -jnp.sign(x) * z, jnp.where(is_y, x, jnp.sign(z) * x))
    v = jnp.where(is_x, -y, jnp.where(is_y, jnp.sign(y) * z, -y))
    major = jnp.maximum(jnp.where(is_x, ax, jnp.where(is_y, ay, az)), _TINY)
    sign = jnp.where(is_x, x, jnp.where(is_y, y, z))
    side = jnp.where(is_x, 0, jnp.where(is_y, 2, 4)) + jnp.where(sign < 0.0, 1, 0)
    return (0.5 + 0.5 * u / major, 0.5 + 0.5 * v / major), side.astype(jnp.int32)


def _steps(value: Array) -> list[Array]:
    """Returns by how much `value` changes from pixel to pixel along either axis; beside an outline, on this side."""
    result = []
    for axis in (0, 1):
        ahead = jnp.abs(jnp.diff(value, axis=axis))
        pad = [(0, 0), (0, 0)]
        pad[axis] = (0, 1)
        forward = jnp.pad(ahead, pad, constant_values=jnp.inf)
        pad[axis] = (1, 0)
        nearest = jnp.minimum(forward, jnp.pad(ahead, pad, constant_values=jnp.inf))
        result.append(jnp.where(jnp.isfinite(nearest), nearest, 0.0))
    return result


def _texel(textures: Textures, index: Array) -> Vector:
    packed = _take(textures.texels, index)
    red, green, blue = ((packed >> shift & 0xFF).astype(jnp.float32) / 255.0 for shift in (0, 8, 16))
    return red, green, blue


def _neighbours(coordinate: Array, count: Array, is_cube: Array) -> list[tuple[Array, Array]]:
    """Returns the two texels next to a coordinate along one axis, with their weights."""
    place = coordinate * count.astype(jnp.float32) - 0.5
    first = jax.lax.stop_gradient(jnp.floor(place))
    weight, result = place - first, []
    for step, share in ((0, 1.0 - weight), (1, weight)):
        index = first.astype(jnp.int32) + step
        result.append((jnp.where(is_cube, jnp.clip(index, 0, count - 1), jnp.remainder(index, count)), share))
    return result


def _bilinear(textures: Textures, where: tuple[Array, Array, Array], uv: Coordinates, is_cube: Array) -> Vector:
    """Returns the colour between four texels; `where` is texture, side and level. Cubes end at their edges."""
    texture, side, level = where
    start = _take(textures.start, (texture * 6 + side) * textures.num_levels + level)
    width, height = (
        jnp.maximum(_take(count, texture).astype(jnp.int32) >> level, 1) for count in (textures.width, textures.height)
    )
    total = [jnp.zeros_like(uv[0])] * 3
    for row, weight_v in _neighbours(uv[1], height, is_cube):
        for column, weight_u in _neighbours(uv[0], width, is_cube):
            texel = _texel(textures, start + row * width + column)
            total = [t + weight_u * weight_v * c for t, c in zip(total, texel, strict=True)]
    return total[0], total[1], total[2]


def _trilinear(textures: Textures, texture: Array, side: Array, uv: Coordinates, is_cube: Array) -> Vector:
    counts = (_take(textures.width, texture), _take(textures.height, texture))
    steps = [_steps(jax.lax.stop_gradient(c * n)) for c, n in zip(uv, counts, strict=True)]
    squared = jnp.maximum(steps[0][0] ** 2 + steps[1][0] ** 2, steps[0][1] ** 2 + steps[1][1] ** 2)
    deepest = jnp.floor(jnp.log2(jnp.maximum(counts[0], counts[1])))
    level = jnp.clip(0.5 * jnp.log2(jnp.maximum(squared, 1.0)), 0.0, deepest)
    first = jnp.floor(level)
    near, far = first.astype(jnp.int32), jnp.minimum(first + 1.0, deepest).astype(jnp.int32)
    a = _bilinear(textures, (texture, side, near), uv, is_cube)
    b = _bilinear(textures, (texture, side, far), uv, is_cube)
    red, green, blue = (p + (level - first) * (q - p) for p, q in zip(a, b, strict=True))
    return red, green, blue


def colour(
    textures: Textures,
    slot: Array,
    starts: tuple[tuple[int, int], ...],
    local: tuple[Vector, Vector],
    texcoord: Coordinates | None,
) -> Vector:
    """Returns by what each pixel's texture multiplies its colour, three f32[H, W]; 1 where there is none.

    Args:
      textures: Textures.
      slot: i32[H, W], row of each pixel's geom.
      starts: see `surface.level`.
      local: sizes of each pixel's geom, and the point in its frame; three f32[H, W] m each.
      texcoord: two f32[H, W], from faces that have some, or None without such faces.
    """
    size, point = local
    mode = _take(jnp.asarray(textures.modes, dtype=jnp.int32), slot)
    texture = _take(textures.texture, slot)
    u, v, side = point[0], point[1], jnp.zeros_like(slot)
    if PRIMITIVE in textures.modes:
        for kind, start in starts:
            other = _COORDINATES[kind](size, point)
            u, v = (jnp.where((slot >= start) & (mode == PRIMITIVE), b, a) for a, b in zip((u, v), other, strict=True))
    if FACES in textures.modes and texcoord is not None:
        u, v = (jnp.where(mode == FACES, b, a) for a, b in zip((u, v), texcoord, strict=True))
    (su, sv), (tu, tv) = ([_take(row, slot) for row in table] for table in (textures.scale, textures.shift))
    u, v = u * su + tu, v * sv + tv
    if CUBE in textures.modes:
        way = [p / _take(row, slot) for p, row in zip(point, textures.extent, strict=True)]
        (cube_u, cube_v), cube_side = _cube((way[0], way[1], way[2]))
        u, v = jnp.where(mode == CUBE, cube_u, u), jnp.where(mode == CUBE, cube_v, v)
        side = jnp.where(mode == CUBE, cube_side, side)
    one = jnp.ones_like(u)
    rgb = _trilinear(textures, texture, side, (u, v), mode == CUBE)
    return select(mode != PLAIN, (one, rgb), (one, (one, one, one)))[1]


def sky(textures: Textures, way: Vector) -> Vector:
    """Returns the sky's colour in the direction `way` (three f32[H, W], world); the texture's y is up."""
    assert textures.sky is not None
    uv, side = _cube((way[0], way[2], -way[1]))
    texture = jnp.full_like(side, textures.sky)
    return _trilinear(textures, texture, side, uv, jnp.ones_like(side, dtype=bool))
