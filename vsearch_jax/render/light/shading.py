"""MuJoCo's light model, evaluated in every pixel: OpenGL's ambient, diffuse and specular terms of every light.

The formulas are those of the OpenGL 2.1 specification, section 2.14.1, with the settings that MuJoCo makes in
render_gl3.c (`initLights`, `adjustLight`, `renderGeom`): a local viewer, one-sided lighting, ambient and diffuse colour
from the geom, one specular value per geom. OpenGL evaluates them at the vertices, this module at each pixel.

All positions and directions are in the camera's frame.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from vsearch_jax.render.lights import Lights
from vsearch_jax.render.scene import RenderScene
from vsearch_jax.xla.vectors import Vector, dot

# Lower bound of squared lengths, so that the gradients of their roots are finite.
_TINY = 1e-12


class Surface(NamedTuple):
    """The surface that each pixel of an H x W image shows, in the camera's frame.

    Attributes:
      point: three f32[H, W] m, the point that the pixel shows.
      normal: three f32[H, W], unit, towards the camera's side. On a face it is the interpolated smooth normal.
      flat: three f32[H, W], unit, towards the camera's side. On a face it is the normal of the face's plane, elsewhere
        it equals `normal`.
      rgb: three f32[H, W] in [0, 1], colour of the geom.
      specular: f32[H, W] in [0, 1], strength of the highlight.
      shininess: f32[H, W], exponent of the highlight.
      emission: f32[H, W], emitted light in units of `rgb`.
      tint: three f32[H, W], colour of the texture, which multiplies the lit colour; None in a scene without textures.
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
    """How one light falls on the surface that each pixel of an H x W image shows: the terms of MuJoCo's light model.

    Attributes:
      strength: f32[H, W], the part of the light that arrives, after attenuation, cone and shadows.
      diffuse: f32[H, W], cosine of the angle of incidence, at least 0.
      specular: f32[H, W], intensity of the highlight, at least 0.
    """

    strength: Array
    diffuse: Array
    specular: Array


def _incidence(surface: Surface, to_camera: Vector, to_light: Vector, strength: Array) -> Incidence:
    """Returns the terms of a light in direction `to_light`: Lambert's diffuse term and Blinn's highlight."""
    cosine = dot(surface.normal, to_light)
    # The half vector is (to_light + to_camera) / |to_light + to_camera|.
    inverse = 1.0 / jnp.sqrt(jnp.maximum(2.0 + 2.0 * dot(to_light, to_camera), _TINY))
    half_cosine = (cosine + dot(surface.normal, to_camera)) * inverse
    highlight = jnp.exp(surface.shininess * jnp.log(jnp.clip(half_cosine, 1e-6, 1.0)))
    return Incidence(strength, jnp.maximum(cosine, 0.0), jnp.where(cosine > 0.0, highlight, 0.0))


def directional_incidence(surface: Surface, to_camera: Vector, to_light: Array, is_lit: Array) -> Incidence:
    """Computes how a directional light falls on the surface that each pixel of an H x W image shows.

    Args:
      surface: the surface that each pixel shows.
      to_camera: three f32[H, W], unit vectors from the surface to the camera.
      to_light: f32[3], unit vector towards the light.
      is_lit: f32[H, W] or f32[], 0 where another geom shadows the light, 1 elsewhere.
    """
    return _incidence(surface, to_camera, (to_light[0], to_light[1], to_light[2]), is_lit)


def positional_incidence(
    surface: Surface, to_camera: Vector, pose: tuple[Array, Array], lights: Lights, index: int, is_lit: Array
) -> Incidence:
    """Computes how a spot or point light falls on the surface that each pixel of an H x W image shows.

    Args:
      surface: the surface that each pixel shows.
      to_camera: three f32[H, W], unit vectors from the surface to the camera.
      pose: position f32[3] m of the light, and unit vector f32[3] along which the light shines.
      lights: all lights of the scene. Attenuation, cutoff and exponent are read.
      index: number of this light in `lights`; static.
      is_lit: f32[H, W] or f32[], 0 where another geom shadows the light, 1 elsewhere.
    """
    position, direction = pose
    offset = (position[0] - surface.point[0], position[1] - surface.point[1], position[2] - surface.point[2])
    distance = jnp.sqrt(jnp.maximum(dot(offset, offset), _TINY))
    to_light = (offset[0] / distance, offset[1] / distance, offset[2] / distance)
    constant, linear, quadratic = lights.attenuation[index]
    attenuation = 1.0 / (constant + distance * (linear + distance * quadratic))
    axis_cosine = -(to_light[0] * direction[0] + to_light[1] * direction[1] + to_light[2] * direction[2])
    cone = jnp.exp(lights.exponent[index] * jnp.log(jnp.clip(axis_cosine, 1e-6, 1.0)))
    # A point light has a cutoff of pi, so its cone holds all directions.
    cone = jnp.where(axis_cosine >= jnp.cos(lights.cutoff[index]), cone, 0.0)
    return _incidence(surface, to_camera, to_light, is_lit * attenuation * cone)


def shade(scene: RenderScene, surface: Surface, incidences: list[Incidence]) -> list[Array]:
    """Computes the colour of each pixel of an H x W image from its surface and the lights that fall on it.

    MuJoCo draws the lights without shadows in one pass, and adds a pass for each light that casts shadows. OpenGL
    clamps the light of each pass to [0, 1] and multiplies it by the texture.

    Args:
      scene: the compiled scene. The colours of the lights are read.
      surface: the surface that each pixel shows.
      incidences: how each light falls on the surface: the lights in the scene's order, then the headlight.

    Returns:
      Red, green and blue, f32[H, W] in [0, 1] each.
    """
    if surface.tint is None:  # the light of all passes together is clamped, too
        return [_lit_channel(scene, surface, incidences, i, None) for i in range(3)]
    casters = scene.shadow_casters
    first = [light for light in range(len(incidences)) if light not in casters]
    channels = []
    for i, tint in enumerate(surface.tint):
        total = tint * _lit_channel(scene, surface, incidences, i, first)
        for light in casters:
            total += tint * _lit_channel(scene, surface, incidences, i, [light])
        channels.append(jnp.minimum(total, 1.0) if casters else total)
    return channels


def _lit_channel(
    scene: RenderScene, surface: Surface, incidences: list[Incidence], channel: int, subset: list[int] | None
) -> Array:
    """Returns one channel of the colour, f32[H, W], by one pass over the lights of `subset`; None is all lights.

    Emission and light without a source belong to the pass of the headlight.
    """
    lights, headlight = scene.lights, len(incidences) - 1
    colours = [(lights.ambient[i], lights.diffuse[i], lights.specular[i]) for i in range(headlight)]
    colours.append((scene.headlight_ambient, scene.headlight_diffuse, scene.headlight_specular))
    subset = list(range(len(incidences))) if subset is None else subset
    base = surface.emission + scene.ambient[channel] if headlight in subset else jnp.zeros_like(surface.emission)
    highlight = 0.0
    for index in subset:
        (ambient, diffuse, specular), light = colours[index], incidences[index]
        base += light.strength * (ambient[channel] + diffuse[channel] * light.diffuse)
        highlight += light.strength * specular[channel] * light.specular
    return jnp.clip(surface.rgb[channel] * base + surface.specular * highlight, 0.0, 1.0)
