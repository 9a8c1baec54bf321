"""Where the lights are as the camera sees them, and how they meet what each pixel shows."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from vsearch_jax.render import trace
from vsearch_jax.render.light import shading, shadow_map
from vsearch_jax.render.light.shadow_map import ShadowMap
from vsearch_jax.render.scene import RenderScene
from vsearch_jax.types import Camera
from vsearch_jax.xla.vectors import Vector


class LightPoses(NamedTuple):
    """The lights in the camera's frame.

    Attributes:
      position: f32[L, 3] m.
      direction: f32[L, 3], unit vectors along which the lights shine.
    """

    position: Array
    direction: Array


def light_poses(scene: RenderScene, data: Any, camera: Camera) -> LightPoses:
    """Returns where the lights are: fixed in the world, or in the frames of the bodies that carry them."""
    positions, directions = [], []
    for index, body in enumerate(scene.lights.bodies):
        position, direction = scene.lights.position[index], scene.lights.direction[index]
        if body:
            rotation = jnp.asarray(data.xmat[body], dtype=jnp.float32).reshape(3, 3)
            body_position = jnp.asarray(data.xpos[body], dtype=jnp.float32)
            position, direction = rotation @ position + body_position, rotation @ direction
        positions.append(camera.rotation.T @ (position - camera.position))
        directions.append(camera.rotation.T @ direction)
    if not positions:
        return LightPoses(jnp.zeros((0, 3), jnp.float32), jnp.zeros((0, 3), jnp.float32))
    return LightPoses(jnp.stack(positions), jnp.stack(directions))


def _shadowing(scene: RenderScene) -> list[int]:
    return [i for i, casts in enumerate(scene.lights.is_shadowing) if casts and scene.has_shadows]


def _place(scene: RenderScene, poses: LightPoses, index: int) -> tuple[Array, bool]:
    """Returns the light's position, or the direction towards it; and whether it is the latter."""
    is_directional = scene.lights.is_directional[index]
    return (-poses.direction[index] if is_directional else poses.position[index]), is_directional


def needs_shadow_maps(scene: RenderScene) -> bool:
    """Returns whether faces cast shadows."""
    return scene.triangles is not None and bool(_shadowing(scene))


def shadow_maps(
    scene: RenderScene, frames: trace.Frames, poses: LightPoses, seen: tuple[Vector, Array], zero: Array
) -> dict[int, ShadowMap]:
    """Returns the shadows of faces by the light's number; `seen` is what `shadow_map.cast` takes."""
    return {i: shadow_map.cast(scene, frames, seen, _place(scene, poses, i), zero) for i in _shadowing(scene)}


def _is_lit(
    scene: RenderScene,
    frames: trace.Frames,
    hits: trace.Hits,
    light: tuple[Array, bool],
    rays: tuple[Array, Array],
) -> Array:
    fixed = jax.lax.stop_gradient((scene, frames, hits, rays, light[0]))
    return trace.is_lit(*fixed, light[1])


def lit_by(
    scene: RenderScene,
    frames: trace.Frames,
    hits: trace.Hits,
    rays: tuple[Array, Array],
    lights: tuple[LightPoses, dict[int, ShadowMap]],
    surface: shading.Surface,
) -> dict[int, Array]:
    """Returns f32[H, W], 0 in the shadow and 1 elsewhere, by the number of each light that casts shadows."""
    poses, maps = jax.lax.stop_gradient(lights)
    lit = {}
    for index in _shadowing(scene):
        light = _place(scene, poses, index)
        lit[index] = _is_lit(scene, frames, hits, light, rays)
        if index in maps:
            point, normal = jax.lax.stop_gradient((surface.point, surface.flat))
            lit[index] *= shadow_map.is_lit(maps[index], point, normal, light[1], scene.shadow_offset)
    return lit


def incidences(
    scene: RenderScene,
    poses: LightPoses,
    surface: shading.Surface,
    rays: tuple[Array, Array],
    lit: dict[int, Array],
) -> list[shading.Incidence]:
    """Returns how the scene's lights in their order, then the headlight, meet each pixel's surface."""
    view, result, one = _view(*rays), [], jnp.ones((), dtype=jnp.float32)
    for index, is_directional in enumerate(scene.lights.is_directional):
        is_lit = lit.get(index, one)
        if is_directional:
            result.append(shading.directional_incidence(surface, view, -poses.direction[index], is_lit))
        else:
            pose = (poses.position[index], poses.direction[index])
            result.append(shading.positional_incidence(surface, view, pose, scene.lights, index, is_lit))
    forward = jnp.array([0.0, 0.0, 1.0], dtype=jnp.float32)
    return [*result, shading.directional_incidence(surface, view, forward, one)]


def _view(x: Array, y: Array) -> Vector:
    inverse = 1.0 / jnp.sqrt(x * x + y * y + 1.0)
    return -x * inverse, -y * inverse, inverse
