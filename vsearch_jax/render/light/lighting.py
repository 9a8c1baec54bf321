"""The lights of a scene at each pixel: shadows, and the terms of the light model.

Shadows have two sources. Shadows of primitives come from exact shadow rays (`render.trace.is_lit`). Shadows of meshes
and height fields come from shadow maps (`render.light.shadow_map`). A pixel is lit if both say so. Shadows have no
derivative.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import Array

from vsearch_jax.render import trace
from vsearch_jax.render.light import shading, shadow_map
from vsearch_jax.render.light.shadow_map import ShadowMap
from vsearch_jax.render.lights import LightPoses
from vsearch_jax.render.scene import RenderScene
from vsearch_jax.xla.vectors import Vector


def _light_source(scene: RenderScene, poses: LightPoses, index: int) -> tuple[Array, bool]:
    """Returns f32[3] and whether the light is directional: a direction towards such a light, else a position in m."""
    is_directional = scene.lights.is_directional[index]
    return (-poses.direction[index] if is_directional else poses.position[index]), is_directional


def needs_shadow_maps(scene: RenderScene) -> bool:
    """Returns whether a shadow map is needed: the scene has meshes or height fields, and a light that casts shadows."""
    return scene.triangles is not None and bool(scene.shadow_casters)


def shadow_maps(
    scene: RenderScene, frames: trace.Frames, poses: LightPoses, seen: tuple[Vector, Array], zero: Array
) -> dict[int, ShadowMap]:
    """Draws a shadow map for each light that casts shadows. The maps hold the shadows of meshes and height fields.

    Args:
      scene: the compiled scene, with meshes or height fields.
      frames: poses of the geoms relative to the camera.
      poses: poses of the lights in the camera's frame.
      seen: point that each pixel sees, three f32[...] m in the camera's frame; and bool[...], whether there is one.
      zero: i32[], a 0 that the compiler does not know to be 0. It keeps XLA from computing results twice.

    Returns:
      {number of the light in the scene: its shadow map}.
    """
    return {
        i: shadow_map.draw_shadow_map(scene, frames, seen, _light_source(scene, poses, i), zero)
        for i in scene.shadow_casters
    }


def lit_by(
    scene: RenderScene,
    frames: trace.Frames,
    hits: trace.Hits,
    rays: tuple[Array, Array],
    lights: tuple[LightPoses, dict[int, ShadowMap]],
    surface: shading.Surface,
) -> dict[int, Array]:
    """Computes for each light that casts shadows which pixels of an H x W image the light reaches.

    Args:
      scene: the compiled scene.
      frames: poses of the geoms relative to the camera.
      hits: geom that each pixel shows, with exact depth.
      rays: x f32[1, W] and y f32[H, 1] of the directions (x, y, -1) of the pixels' rays, in the camera's frame.
      lights: poses of the lights in the camera's frame, and the result of `shadow_maps` (empty without triangles).
      surface: point and normal of the surface that each pixel shows.

    Returns:
      {number of the light in the scene: f32[H, W], 0 in the shadow and 1 elsewhere}.
    """
    poses, maps = jax.lax.stop_gradient(lights)
    lit = {}
    for index in scene.shadow_casters:
        source, is_directional = _light_source(scene, poses, index)
        fixed = jax.lax.stop_gradient((scene, frames, hits, rays, source))
        lit[index] = trace.is_lit(*fixed, is_directional)
        if index in maps:
            point, normal = jax.lax.stop_gradient((surface.point, surface.flat))
            lit[index] *= shadow_map.is_lit(maps[index], point, normal, is_directional, scene.shadow_offset)
    return lit


def incidences(
    scene: RenderScene,
    poses: LightPoses,
    surface: shading.Surface,
    rays: tuple[Array, Array],
    lit: dict[int, Array],
) -> list[shading.Incidence]:
    """Computes the diffuse and specular light of each light source at the surface that each pixel of an image shows.

    The image has H x W pixels.

    Args:
      scene: the compiled scene.
      poses: poses of the lights in the camera's frame.
      surface: the surface that each pixel shows.
      rays: x f32[1, W] and y f32[H, 1] of the directions (x, y, -1) of the pixels' rays, in the camera's frame.
      lit: shadows of the lights, from `lit_by`. A light that is missing there has no shadows.

    Returns:
      Strength, diffuse and specular term of each light in the scene's order, then of the headlight. The headlight
      shines along the camera's axis.
    """
    to_camera, result, one = _to_camera(*rays), [], jnp.ones((), dtype=jnp.float32)
    for index, is_directional in enumerate(scene.lights.is_directional):
        is_lit = lit.get(index, one)
        if is_directional:
            result.append(shading.directional_incidence(surface, to_camera, -poses.direction[index], is_lit))
        else:
            pose = (poses.position[index], poses.direction[index])
            result.append(shading.positional_incidence(surface, to_camera, pose, scene.lights, index, is_lit))
    backward = jnp.array([0.0, 0.0, 1.0], dtype=jnp.float32)
    return [*result, shading.directional_incidence(surface, to_camera, backward, one)]


def _to_camera(x: Array, y: Array) -> Vector:
    """Returns unit vectors to the camera from points on the rays of slopes `x` and `y`."""
    inverse = 1.0 / jnp.sqrt(x * x + y * y + 1.0)
    return -x * inverse, -y * inverse, inverse
