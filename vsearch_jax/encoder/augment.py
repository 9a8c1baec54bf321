"""Domain randomisation (thesis 3.3): lights and camera before rendering, the image after it."""

from __future__ import annotations

import dataclasses

import dm_pix
import jax
import jax.numpy as jnp
from jax import Array
from jaxlie import SO3

from vsearch_jax.config import Config
from vsearch_jax.render.scene import RenderScene
from vsearch_jax.types import Camera

# Lights: largest angle from the vertical, share of the images whose lights stand behind the camera and standard
# deviation of the offset from its direction, and ranges of the factors on the scene's own values.
_MAX_LIGHT_ANGLE = jnp.pi / 3
_BEHIND_PROBABILITY, _BEHIND_SPREAD = 0.6, 0.35
_DIFFUSE_RANGE, _SPECULAR_RANGE, _AMBIENT_RANGE, _TINT_RANGE = (0.4, 1.3), (0.0, 1.5), (0.5, 1.5), (0.85, 1.15)
# Camera: largest tilt as a part of the field of view, and range of the factor on the field of view.
_MAX_SHIFT, _SCALE_RANGE = 0.05, (0.92, 1.08)
# Image.
_NUM_SHADOWS, _SHADOW_RADIUS = 2, (0.08, 0.3)
_BACKGROUND_PROBABILITY = 0.5
_TEXTURE_GRIDS = (1, 2, 8, 32)  # a colour, a gradient, patches, grain
_NUM_OCCLUSIONS, _OCCLUSION_PROBABILITY, _MAX_OCCLUSION = 2, 0.4, 0.35
_MAX_HUE, _SATURATION_RANGE, _CONTRAST_RANGE, _MAX_BRIGHTNESS = 0.3, (0.6, 1.4), (0.7, 1.3), 0.15
_DEPTH_NOISE, _HOLE_FRACTION, _NOISE_GRID = 0.02, 0.02, 32


def randomize_lights(key: Array, scene: RenderScene, center: Array, camera: Camera) -> RenderScene:
    """Returns a copy of the scene with random lights and a random headlight.

    Each light gets a new direction and new diffuse, specular and ambient colours. The light keeps its distance from
    `center` and shines at `center`. With probability 0.6 all lights stand behind the camera, so that the shadow of the
    arm, which carries the camera, falls on the object. Otherwise the direction of each light, seen from `center`, is
    uniform within 60 degrees of the vertical.

    Args:
      key: PRNG key.
      scene: the scene to render.
      center: f32[3] m in world, centre of the view sphere, where the object is.
      camera: the camera in world.
    """
    direction_key, diffuse_key, tint_key, specular_key, ambient_key, headlight_key = jax.random.split(key, 6)
    lights = scene.lights
    shape = lights.position.shape[:1]
    upward = _light_directions(direction_key, shape[0], camera.position - center)
    distance = jnp.linalg.norm(lights.position - center[None], axis=-1, keepdims=True)
    tint = _uniform(tint_key, (*shape, 3), _TINT_RANGE)
    lights = dataclasses.replace(
        lights,
        position=center[None] + distance * upward,
        direction=-upward,
        diffuse=lights.diffuse * tint * _uniform(diffuse_key, (*shape, 1), _DIFFUSE_RANGE),
        specular=lights.specular * _uniform(specular_key, (*shape, 1), _SPECULAR_RANGE),
        ambient=lights.ambient * _uniform(ambient_key, (*shape, 1), _AMBIENT_RANGE),
    )
    factor = _uniform(headlight_key, (), _AMBIENT_RANGE)
    return dataclasses.replace(
        scene,
        lights=lights,
        headlight_ambient=scene.headlight_ambient * factor,
        headlight_diffuse=scene.headlight_diffuse * factor,
    )


def _light_directions(key: Array, count: int, to_camera: Array) -> Array:
    """Returns random unit vectors f32[L, 3] from the object to the L lights, above the table.

    Args:
      key: PRNG key.
      count: number L of the lights.
      to_camera: f32[3] m, from the object to the camera.
    """
    height_key, azimuth_key, behind_key, spread_key = jax.random.split(key, 4)
    height = jax.random.uniform(height_key, (count,), minval=jnp.cos(_MAX_LIGHT_ANGLE), maxval=1.0)
    azimuth = jax.random.uniform(azimuth_key, (count,), maxval=2.0 * jnp.pi)
    across = jnp.sqrt(1.0 - height**2)
    anywhere = jnp.stack([across * jnp.cos(azimuth), across * jnp.sin(azimuth), height], axis=-1)
    behind = _unit(to_camera)[None] + _BEHIND_SPREAD * jax.random.normal(spread_key, (count, 3))
    behind = _unit(behind.at[:, 2].set(jnp.abs(behind[:, 2])))
    return jnp.where(jax.random.bernoulli(behind_key, _BEHIND_PROBABILITY), behind, anywhere)


def _unit(vectors: Array) -> Array:
    """Returns vectors f32[..., 3] scaled to length 1."""
    return vectors / jnp.linalg.norm(vectors, axis=-1, keepdims=True)


def jitter_camera(key: Array, camera: Camera) -> Camera:
    """Returns the camera with a random tilt and zoom.

    The image shifts by up to 5 % of its size and scales by up to 8 %. The camera changes before the image is
    rendered, so this costs no time. Resampling the rendered image would take longer than all other image operations
    together.

    Args:
      key: PRNG key.
      camera: the camera in world; the position does not change.
    """
    tilt_key, scale_key = jax.random.split(key)
    tilt = jax.random.uniform(tilt_key, (2,), minval=-_MAX_SHIFT, maxval=_MAX_SHIFT) * camera.fovy
    rotation = SO3.exp(jnp.append(tilt, 0.0)).as_matrix()
    fovy = camera.fovy * _uniform(scale_key, (), _SCALE_RANGE)
    return dataclasses.replace(camera, rotation=camera.rotation @ rotation, fovy=fovy)


def augment_input(key: Array, x: Array, is_object: Array, config: Config) -> Array:
    """Adds random disturbances to the encoder's input image. The encoder must learn to ignore them.

    Each kind of input gets occlusions. rgb and depth get a random background with probability
    1/2. Then rgb gets random hue, saturation, contrast and brightness; depth gets noise and holes; a silhouette gets
    inverted spots.

    Args:
      key: PRNG key.
      x: input image f32[H, W, C] in [0, 1] of H x W pixels and C channels, from `network_input`.
      is_object: bool[H, W], true on the object.
      config: the run's config; `encoder.input` is the kind of the input.

    Returns:
      Disturbed image, f32[H, W, C] in [0, 1].
    """
    background_key, occlusion_key, sensor_key = jax.random.split(key, 3)
    if config.encoder.input == "silhouette":
        return _disturb_silhouette(sensor_key, jnp.round(occlude(occlusion_key, x)))
    x = occlude(occlusion_key, replace_background(background_key, x, is_object))
    disturb = _disturb_rgb if config.encoder.input == "rgb" else _disturb_depth
    return jnp.clip(disturb(sensor_key, x), 0.0, 1.0)


def clean_target(x: Array, is_object: Array, config: Config) -> Array:
    """Returns the image that the decoder must reproduce: only the object. All else is black, or far for depth.

    Args:
      x: image f32[h, w, C] in [0, 1] of h x w pixels and C channels, from `network_input`.
      is_object: bool[h, w], true on the object.
      config: the run's config.
    """
    blank = 1.0 if config.encoder.input == "depth" else 0.0
    return jnp.where(is_object[..., None], x, blank)


def replace_background(key: Array, x: Array, is_object: Array) -> Array:
    """Puts a random texture behind the object with probability 1/2, and returns the image.

    Args:
      key: PRNG key.
      x: image f32[H, W, C] in [0, 1] of H x W pixels and C channels.
      is_object: bool[H, W], true on the object.
    """
    choice_key, texture_key = jax.random.split(key)
    is_replaced = jax.random.bernoulli(choice_key, _BACKGROUND_PROBABILITY)
    return jnp.where(is_replaced & ~is_object[..., None], _texture(texture_key, x.shape), x)


def draw_shade(key: Array, size: int) -> Array:
    """Draws where the shadows of two links of an arm might fall: bool[size, size].

    The shadows are strips with round ends, of random place, direction, length and width. The arm's own shadows are
    rendered too, but few of them cover the object.

    Args:
      key: PRNG key.
      size: height and width of the image in pixels.
    """
    start_key, angle_key, length_key, radius_key = jax.random.split(key, 4)
    starts = jax.random.uniform(start_key, (_NUM_SHADOWS, 2))
    angles = jax.random.uniform(angle_key, (_NUM_SHADOWS,), maxval=2.0 * jnp.pi)
    lengths = jax.random.uniform(length_key, (_NUM_SHADOWS,))
    radii = _uniform(radius_key, (_NUM_SHADOWS,), _SHADOW_RADIUS)
    rows, columns = _pixel_centers(size)[:, None], _pixel_centers(size)[None]
    is_dark = jnp.zeros((size, size), bool)
    for (row, column), angle, length, radius in zip(starts, angles, lengths, radii, strict=True):
        down, across, cos, sin = rows - row, columns - column, jnp.cos(angle), jnp.sin(angle)
        along = jnp.clip(down * cos + across * sin, 0.0, length)
        is_dark |= (down - along * cos) ** 2 + (across - along * sin) ** 2 < radius**2
    return is_dark


def occlude(key: Array, x: Array) -> Array:
    """Covers parts of an image with up to two rectangles of random position, size and colour.

    Args:
      key: PRNG key.
      x: image f32[H, W, C] in [0, 1] of H x W pixels and C channels.
    """
    height, width, features = x.shape
    numbers = jax.random.uniform(key, (_NUM_OCCLUSIONS, 5 + features))
    for chance, row, column, half_height, half_width, *color in numbers:
        rows = jnp.abs(_pixel_centers(height) - row) < 0.5 * _MAX_OCCLUSION * half_height
        columns = jnp.abs(_pixel_centers(width) - column) < 0.5 * _MAX_OCCLUSION * half_width
        is_inside = rows[:, None] & columns[None, :] & (chance < _OCCLUSION_PROBABILITY)
        x = jnp.where(is_inside[..., None], jnp.stack(color)[None, None], x)
    return x


def _disturb_rgb(key: Array, x: Array) -> Array:
    """Returns the rgb input f32[H, W, 3] with random hue, saturation, contrast and brightness."""
    color_key, contrast_key, brightness_key = jax.random.split(key, 3)
    x = x @ _color_matrix(color_key)
    contrasted = dm_pix.random_contrast(contrast_key, x, *_CONTRAST_RANGE)
    return jnp.asarray(dm_pix.random_brightness(brightness_key, contrasted, _MAX_BRIGHTNESS))


def _color_matrix(key: Array) -> Array:
    """Returns a random f32[3, 3] for hue and saturation; a row of rgb is multiplied by it from the right.

    Hue is a rotation about the grey axis. Saturation is a scale across this axis. Grey does not change.
    dm-pix converts to HSV instead. XLA on CPU computes the HSV again for each use, which makes `augment_input`
    15 times slower.
    """
    hue_key, saturation_key = jax.random.split(key)
    angle = _MAX_HUE * jax.random.uniform(hue_key, minval=-1.0, maxval=1.0)
    saturation = _uniform(saturation_key, (), _SATURATION_RANGE)
    grey = jnp.full((3, 3), 1.0 / 3.0)
    rotation = SO3.exp(angle * jnp.full(3, 3.0**-0.5)).as_matrix()
    return grey + saturation * (rotation - grey)


def _disturb_depth(key: Array, x: Array) -> Array:
    """Returns the depth input f32[H, W, 1] with patches of noise and with holes, as of a stereo sensor.

    A hole has the value 1 (far), as such sensors report it.
    """
    noise_key, hole_key = jax.random.split(key)
    x = x + _DEPTH_NOISE * (2.0 * _noise(noise_key, x.shape, _NOISE_GRID) - 1.0)
    return jnp.where(_spots(hole_key, x.shape), 1.0, x)


def _disturb_silhouette(key: Array, x: Array) -> Array:
    """Returns the silhouette f32[H, W, 1], inverted in some small spots."""
    return jnp.where(_spots(key, x.shape), 1.0 - x, x)


def _spots(key: Array, shape: tuple[int, ...]) -> Array:
    """Returns bool of `shape` (H, W, 1), true in about one of 50 small patches."""
    grid = jax.random.bernoulli(key, _HOLE_FRACTION, (_NOISE_GRID, _NOISE_GRID, 1)).astype(jnp.float32)
    return jax.image.resize(grid, shape, "linear") > 0.5


def _texture(key: Array, shape: tuple[int, ...]) -> Array:
    """Returns f32 of `shape` (H, W, C) in [0, 1]: a random mean of a colour, a gradient, patches and grain."""
    weight_key, noise_key = jax.random.split(key)
    weights = jax.nn.softmax(3.0 * jax.random.normal(weight_key, (len(_TEXTURE_GRIDS),)))
    features, finest = shape[-1], _TEXTURE_GRIDS[-1]
    numbers = jax.random.uniform(noise_key, (sum(grid**2 for grid in _TEXTURE_GRIDS), features))
    total, start = jnp.zeros((finest, finest, features)), 0
    for weight, grid in zip(weights, _TEXTURE_GRIDS, strict=True):
        noise = numbers[start : start + grid**2].reshape(grid, grid, features)
        total += weight * jax.image.resize(noise, total.shape, "linear")
        start += grid**2
    return jax.image.resize(total, shape, "linear")


def _noise(key: Array, shape: tuple[int, ...], grid: int) -> Array:
    """Returns noise in [0, 1] of `shape` (H, W, C), drawn on a coarse grid and interpolated.

    To draw a number for every pixel takes longer than to encode the image.
    """
    return jax.image.resize(jax.random.uniform(key, (grid, grid, shape[-1])), shape, "linear")


def _pixel_centers(count: int) -> Array:
    """Returns f32[count], centres of the pixels of a row or column of length 1."""
    return (jnp.arange(count, dtype=jnp.float32) + 0.5) / count


def _uniform(key: Array, shape: tuple[int, ...], limits: tuple[float, float]) -> Array:
    return jax.random.uniform(key, shape, minval=limits[0], maxval=limits[1])
