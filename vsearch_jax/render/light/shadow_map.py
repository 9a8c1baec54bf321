"""Shadow maps of meshes and height fields.

The method is shadow mapping (Williams, "Casting curved shadows on curved surfaces", SIGGRAPH 1978). The light draws a
depth image of the faces, the map. A point is in the shadow if the map's depth in its direction is smaller than the
point's own depth. The rasteriser draws the map as it draws the camera's image. Shadow rays against all faces would cost
far more.

- **Resolution.** The map has about as many cells as the image has pixels. Its window is the intersection of two
  rectangles in the light's view: that of the faces, and that of the points that the camera sees. So a cell is about as
  large as a pixel there, and shadow edges are right to about a pixel.
- **Self-shadowing.** The point's depth is not compared in the point's own direction but in that of the cell's centre.
  For this the surface is extended as a plane. A small bias covers the curvature of the surface.
- **Limit.** A spot or point light sees only directions within 80 degrees of the direction to the centre of the faces,
  along each axis. Outside of this pyramid only primitives cast its shadows.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from vsearch_jax.render import trace
from vsearch_jax.render.geometry.projection import Pinhole, Projection
from vsearch_jax.render.geometry.rasterizer import rasterize
from vsearch_jax.render.geometry.triangles import Triangles
from vsearch_jax.render.scene import RenderScene
from vsearch_jax.xla.vectors import Vector, dot

# Cells along an edge of a map for each pixel along an edge of a square image of the same number of pixels.
_CELLS_PER_PIXEL = 1.0
_MAX_CELLS = 1024
# Tangent of the largest angle between a ray of the light and the axis of its view: 80 degrees.
_MAX_TANGENT = 5.7
# Cells. The extended plane may change a point's depth by at most this many times the width of a cell.
_MAX_EXTENSION = 8.0
# Cells. A point counts as lit if it is behind the map's depth by less than this many times the width of a cell.
_BIAS = 0.3


class ShadowMap(NamedTuple):
    """A depth image as a light sees the faces of meshes and height fields. The image has S x S cells (pixels).

    Attributes:
      depth: f32[S, S] m along the axis of the light's view, +inf where a ray meets no face.
      rotation: f32[3, 3], camera's frame to the light's frame. The light's view looks along -z.
      origin: f32[3] m, origin of the light's frame in the camera's frame.
      pinhole: Pinhole, how the light's view maps onto cells.
    """

    depth: Array
    rotation: Array
    origin: Array
    pinhole: Pinhole


def _frame_from_z(z: Array) -> Array:
    """Returns f32[3, 3], a rotation whose last row is the unit vector `z`."""
    helper = jnp.where(jnp.abs(z[0]) < 0.7, jnp.array([1.0, 0.0, 0.0]), jnp.array([0.0, 1.0, 0.0]))
    x = jnp.cross(helper, z)
    x = x / jnp.sqrt(jnp.sum(x * x))
    return jnp.stack([x, jnp.cross(z, x), z])


def _bounds_of_spheres(center: Array, radius: Array, is_directional: bool) -> tuple[Array, Array]:
    """Returns the smallest and the largest x and y of spheres in the light's view, f32[2] each.

    Args:
      center: f32[M, 3] m, in the light's frame.
      radius: f32[M] m.
      is_directional: static. The units are m for a directional light, else tangents.
    """
    if is_directional:
        return jnp.min(center[:, :2] - radius[:, None], axis=0), jnp.max(center[:, :2] + radius[:, None], axis=0)
    depth = -center[:, 2:]
    middle = jnp.arctan2(center[:, :2], depth)
    distance = jnp.sqrt(center[:, :2] ** 2 + depth**2)
    # A sphere around the light fills all directions.
    half = jnp.where(distance > radius[:, None], jnp.arcsin(jnp.clip(radius[:, None] / distance, 0.0, 1.0)), jnp.pi)
    max_angle = jnp.arctan(_MAX_TANGENT)
    low, high = jnp.min(middle - half, axis=0), jnp.max(middle + half, axis=0)
    return jnp.tan(jnp.clip(low, -max_angle, max_angle)), jnp.tan(jnp.clip(high, -max_angle, max_angle))


def _project(point: Vector, is_directional: bool) -> tuple[Array, Array, Array]:
    """Returns x and y of points (in the light's frame, m) in the light's view, and whether it covers them."""
    depth = -point[2]
    if is_directional:
        return point[0], point[1], jnp.ones_like(depth, dtype=bool)
    is_in_front = depth > 1e-6
    inverse = 1.0 / jnp.where(is_in_front, depth, 1.0)
    x, y = point[0] * inverse, point[1] * inverse
    return x, y, is_in_front & (jnp.abs(x) < _MAX_TANGENT) & (jnp.abs(y) < _MAX_TANGENT)


def _bounds_of_points(x: Array, y: Array, is_seen: Array) -> tuple[Array, Array]:
    """Returns the smallest and the largest x and y, f32[2] each; +inf and -inf where no point is seen."""
    low = jnp.stack([jnp.min(jnp.where(is_seen, axis, jnp.inf)) for axis in (x, y)])
    high = jnp.stack([jnp.max(jnp.where(is_seen, axis, -jnp.inf)) for axis in (x, y)])
    return low, high


def _pinhole(low: Array, high: Array, count: int) -> Pinhole:
    """Returns the mapping of the window from `low` to `high` (f32[2]) onto `count` x `count` cells."""
    scale = count / jnp.maximum(high - low, 1e-6)
    return Pinhole(scale[0], scale[1], -0.5 - scale[0] * low[0], -0.5 + scale[1] * high[1])


def _culled_geoms(triangles: Triangles, frames: trace.Frames, start: int, light: tuple[Array, bool]) -> Array:
    """Returns f32[M], 1 for closed geoms with the light outside their bounding box, else 0."""
    source, is_directional = light
    if is_directional:
        return triangles.is_closed
    local = frames.rotation[start:] @ source + frames.origin[start:]
    is_outside = jnp.any((local < triangles.low) | (local > triangles.high), axis=1)
    return jnp.where(is_outside, triangles.is_closed, 0.0)


def draw_shadow_map(
    scene: RenderScene,
    frames: trace.Frames,
    seen: tuple[Vector, Array],
    light: tuple[Array, bool],
    zero: Array,
) -> ShadowMap:
    """Draws the shadow map of one light: a depth image of meshes and height fields as the light sees them.

    Args:
      scene: the compiled scene, with meshes or height fields.
      frames: poses of the geoms relative to the camera.
      seen: point that each pixel sees, three f32[...] m in the camera's frame; and bool[...], whether there is one.
      light: vector f32[3] in the camera's frame, and whether the light is directional (static). The vector is a unit
        vector towards a directional light, or the position in m of another light.
      zero: i32[], a 0 that the compiler does not know to be 0. It keeps XLA from computing results twice.
    """
    triangles = scene.triangles
    assert triangles is not None
    (point, is_hit), (source, is_directional) = seen, light
    start = scene.num_primitives
    middle = jnp.mean(frames.center[start:], axis=0)
    backward = source if is_directional else source - middle
    rotation = _frame_from_z(backward / jnp.sqrt(jnp.maximum(backward @ backward, 1e-20)))
    origin = middle if is_directional else source
    x, y, is_covered = _project(trace.apply(rotation, point, -rotation @ origin), is_directional)
    is_covered &= is_hit
    low, high = _bounds_of_points(x, y, is_covered)
    center = (frames.center[start:] - origin[None]) @ rotation.T
    faces_low, faces_high = _bounds_of_spheres(center, triangles.radius, is_directional)
    cells = min(_MAX_CELLS, int(_CELLS_PER_PIXEL * is_hit.size**0.5))
    low, high = jnp.maximum(low, faces_low), jnp.minimum(high, faces_high)
    # If the two rectangles do not overlap, no pixel reads the map. Any non-empty window is right then.
    low, high = jnp.where(low < high, low, faces_low), jnp.where(low < high, high, faces_high)
    pinhole = _pinhole(low, high, cells)
    pose = jnp.einsum("ij,gkj->gik", rotation, frames.rotation[start:])
    pose = jnp.concatenate([pose, center[:, :, None]], axis=2).reshape(-1, 12).T
    is_culled = _culled_geoms(triangles, frames, start, light)
    raster = rasterize(triangles, Projection(pose, is_culled, pinhole, is_directional), (cells, cells), zero)
    return ShadowMap(raster.depth, rotation, origin, pinhole)


def is_lit(shadow: ShadowMap, point: Vector, normal: Vector, is_directional: bool, offset: Array) -> Array:
    """Returns for each of H x W points f32[H, W]: 0 if the map has a face between the point and the light, else 1.

    Args:
      shadow: shadow map of the light.
      point: three f32[H, W] m, the points, in the camera's frame.
      normal: three f32[H, W], unit normals of the surface at the points, in the camera's frame.
      is_directional: whether the light is directional; static.
      offset: f32[] m. A face that is nearer to the light by less than this casts no shadow.
    """
    local = trace.apply(shadow.rotation, point, -shadow.rotation @ shadow.origin)
    slope = trace.apply(shadow.rotation, normal)
    x, y, is_covered = _project(local, is_directional)
    pinhole, cells = shadow.pinhole, shadow.depth.shape[0]
    column = jnp.round(pinhole.center_x + pinhole.scale_x * x)
    row = jnp.round(pinhole.center_y - pinhole.scale_y * y)
    is_inside = is_covered & (column >= 0) & (column < cells) & (row >= 0) & (row < cells)
    index = jnp.where(is_inside, row * cells + column, 0.0).astype(jnp.int32)
    map_depth = shadow.depth.reshape(-1).at[index].get(mode="promise_in_bounds")
    cell_x, cell_y = (column - pinhole.center_x) / pinhole.scale_x, (pinhole.center_y - row) / pinhole.scale_y
    depth, cell_width = -local[2], jnp.maximum(1.0 / pinhole.scale_x, 1.0 / pinhole.scale_y)
    # Depth of the surface's plane on the ray through the cell's centre.
    if is_directional:
        divisor = jnp.where(jnp.abs(slope[2]) < 1e-3, 1e-3, slope[2])
        plane_depth = depth + (slope[0] * (cell_x - x) + slope[1] * (cell_y - y)) / divisor
    else:
        divisor = slope[0] * cell_x + slope[1] * cell_y - slope[2]
        plane_depth = dot(slope, local) / jnp.where(jnp.abs(divisor) < 1e-3, 1e-3, divisor)
        cell_width = cell_width * depth
    plane_depth = jnp.clip(plane_depth, depth - _MAX_EXTENSION * cell_width, depth + _MAX_EXTENSION * cell_width)
    return jnp.where(is_inside & (map_depth < plane_depth - _BIAS * cell_width - offset), 0.0, 1.0)
