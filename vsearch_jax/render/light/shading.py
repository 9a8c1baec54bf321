"""MuJoCo's light model: OpenGL's ambient, diffuse and specular terms of every light, per pixel."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from vsearch_jax.render.scene import Lights, RenderScene
from vsearch_jax.xla.vectors import Vector, dot

_TINY = 1e-12


class Surface(NamedTuple):
    """What each pixel shows, in the camera's frame.

    Attributes:
      point: three f32[H, W] m.
      normal: three f32[H, W], unit, towards the camera's side, of the smooth surface that a face stands for.
      flat: three f32[H, W], the same of the face itself; `normal` elsewhere.
      rgb: three f32[H, W] in [0, 1].
      specular: f32[H, W].
      shininess: f32[H, W].
      emission: f32[H, W].
      tint: three f32[H, W], by which a texture multiplies the lit colour, or None without textures.
    """

    point: Vector
    normal: Vector
    flat: Vector
    rgb: Vector
    specular: Array
    shininess: Array
    emission: Array
    tint: Vector | None


class Incidence(NamedTuple):
    """How a light meets each pixel's surface.

    Attributes:
      strength: f32[H, W], what distance, cone and shadows leave of the light.
      diffuse: f32[H, W], cosine at the surface, 0 or more.
      specular: f32[H, W], the highlight, 0 or more.
    """

    strength: Array
    diffuse: Array
    specular: Array


def _incidence(surface: Surface, view: Vector, to_light: Vector, strength: Array) -> Incidence:
    """Blinn's highlight with a viewer at the camera (OpenGL 2.1 specification, 2.14.1)."""
    cosine = dot(surface.normal, to_light)
    # half = (to_light + view) / |to_light + view|
    inverse = 1.0 / jnp.sqrt(jnp.maximum(2.0 + 2.0 * dot(to_light, view), _TINY))
    half_cosine = (cosine + dot(surface.normal, view)) * inverse
    highlight = jnp.exp(surface.shininess * jnp.log(jnp.clip(half_cosine, 1e-6, 1.0)))
    return Incidence(strength, jnp.maximum(cosine, 0.0), jnp.where(cosine > 0.0, highlight, 0.0))


def directional_incidence(surface: Surface, view: Vector, to_light: Array, is_lit: Array) -> Incidence:
    """Returns how a light at infinity meets the surface.

    Args:
      surface: Surface.
      view: three f32[H, W], unit vectors from the surface towards the camera.
      to_light: f32[3], unit vector towards the light in the camera's frame.
      is_lit: f32[H, W], 0 in the shadow, 1 elsewhere.
    """
    return _incidence(surface, view, (to_light[0], to_light[1], to_light[2]), is_lit)


def positional_incidence(
    surface: Surface, view: Vector, pose: tuple[Array, Array], lights: Lights, index: int, is_lit: Array
) -> Incidence:
    """Returns how light `index`, a spot or a point, meets the surface.

    Args:
      surface: Surface.
      view: three f32[H, W], unit vectors from the surface towards the camera.
      pose: f32[3] m and f32[3], position and direction of the light in the camera's frame.
      lights: for attenuation, cutoff and exponent.
      index: the light's number in `lights`.
      is_lit: f32[H, W], 0 in the shadow, 1 elsewhere.
    """
    position, direction = pose
    way = (position[0] - surface.point[0], position[1] - surface.point[1], position[2] - surface.point[2])
    distance = jnp.sqrt(jnp.maximum(dot(way, way), _TINY))
    to_light = (way[0] / distance, way[1] / distance, way[2] / distance)
    constant, linear, quadratic = lights.attenuation[index]
    fading = 1.0 / (constant + distance * (linear + distance * quadratic))
    axis_cosine = -(to_light[0] * direction[0] + to_light[1] * direction[1] + to_light[2] * direction[2])
    cone = jnp.exp(lights.exponent[index] * jnp.log(jnp.clip(axis_cosine, 1e-6, 1.0)))
    # A cutoff of pi is a point light: all around.
    cone = jnp.where(axis_cosine >= jnp.cos(lights.cutoff[index]), cone, 0.0)
    return _incidence(surface, view, to_light, is_lit * fading * cone)


def shade(scene: RenderScene, surface: Surface, incidences: list[Incidence]) -> list[Array]:
    """Returns red, green and blue, f32[H, W] in [0, 1].

    Args:
      scene: materials and colours of the lights.
      surface: Surface.
      incidences: of the scene's lights in their order, then of the headlight.
    """
    lights = scene.lights
    colours = [(lights.ambient[i], lights.diffuse[i], lights.specular[i]) for i in range(len(lights.is_directional))]
    colours.append((scene.headlight_ambient, scene.headlight_diffuse, scene.headlight_specular))
    channels = []
    for i in range(3):
        matte, gloss = surface.emission + scene.ambient[i], 0.0
        for (ambient, diffuse, specular), light in zip(colours, incidences, strict=True):
            matte += light.strength * (ambient[i] + diffuse[i] * light.diffuse)
            gloss += light.strength * specular[i] * light.specular
        lit = jnp.clip(surface.rgb[i] * matte + surface.specular * gloss, 0.0, 1.0)
        channels.append(lit if surface.tint is None else lit * surface.tint[i])
    return channels
