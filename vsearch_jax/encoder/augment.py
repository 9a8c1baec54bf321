"""Domain randomisation (thesis 3.3): of lights and camera before rendering, of the picture after it."""

from __future__ import annotations

import dm_pix
import jax
import jax.numpy as jnp
from jax import Array
from jaxlie import SO3

from vsearch_jax.config import Config
from vsearch_jax.render.scene import RenderScene
from vsearch_jax.types import Camera

# Lights: greatest angle from the vertical, and ranges of factors of what the scene says.
_MAX_LIGHT_ANGLE = jnp.pi / 3
_DIFFUSE_RANGE, _SPECULAR_RANGE, _AMBIENT_RANGE, _TINT_RANGE = (0.4, 1.3), (0.0, 1.5), (0.5, 1.5), (0.85, 1.15)
# Camera: aim as a part of the field of view, and the factor of the field of view.
_MAX_SHIFT, _SCALE_RANGE = 0.05, (0.92, 1.08)
# Picture.
_BACKGROUND_PROBABILITY = 0.5
_TEXTURE_GRIDS = (1, 2, 8, 32)  # a colour, a gradient, patches and grain
_NUM_OCCLUSIONS, _OCCLUSION_PROBABILITY, _MAX_OCCLUSION = 2, 0.4, 0.35
_MAX_HUE, _SATURATION_RANGE, _CONTRAST_RANGE, _MAX_BRIGHTNESS = 0.3, (0.6, 1.4), (0.7, 1.3), 0.15
_DEPTH_NOISE, _HOLE_FRACTION, _NOISE_GRID = 0.02, 0.02, 32


def randomize_lights(key: Array, scene: RenderScene, center: Array) -> RenderScene:
    """Returns `scene` with other light: each light's place, diffuse, specular and ambient part, and the headlight's.

    A light keeps its distance from `center` and shines at it, from up to 60 degrees off the vertical, uniform over that
    cap.

    Args:
      key: PRNG key.
      scene: RenderScene.
      center: f32[3] m in world, the middle of the view sphere.
    """
    height_key, turn_key, diffuse_key, tint_key, specular_key, ambient_key, headlight_key = jax.random.split(key, 7)
    lights = scene.lights
    shape = lights.position.shape[:1]
    height = jax.random.uniform(height_key, shape, minval=jnp.cos(_MAX_LIGHT_ANGLE), maxval=1.0)
    turn = jax.random.uniform(turn_key, shape, maxval=2.0 * jnp.pi)
    across = jnp.sqrt(1.0 - height**2)
    upward = jnp.stack([across * jnp.cos(turn), across * jnp.sin(turn), height], axis=-1)
    distance = jnp.linalg.norm(lights.position - center[None], axis=-1, keepdims=True)
    tint = _uniform(tint_key, (*shape, 3), _TINT_RANGE)
    lights = lights.replace(  # pyright: ignore[reportAttributeAccessIssue] # flax adds it
        position=center[None] + distance * upward,
        direction=-upward,
        diffuse=lights.diffuse * tint * _uniform(diffuse_key, (*shape, 1), _DIFFUSE_RANGE),
        specular=lights.specular * _uniform(specular_key, (*shape, 1), _SPECULAR_RANGE),
        ambient=lights.ambient * _uniform(ambient_key, (*shape, 1), _AMBIENT_RANGE),
    )
    factor = _uniform(headlight_key, (), _AMBIENT_RANGE)
    return scene.replace(  # pyright: ignore[reportAttributeAccessIssue] # flax adds it
        lights=lights,
        headlight_ambient=scene.headlight_ambient * factor,
        headlight_diffuse=scene.headlight_diffuse * factor,
    )


def jitter_camera(key: Array, camera: Camera) -> Camera:
    """Returns `camera` aimed a little aside and zoomed: the picture shifts by up to 5 % and scales by up to 8 %.

    Shift and scale so cost nothing; resampling a picture takes longer than all other operations on it together.
    """
    aim_key, scale_key = jax.random.split(key)
    tilt = jax.random.uniform(aim_key, (2,), minval=-_MAX_SHIFT, maxval=_MAX_SHIFT) * camera.fovy
    turn = SO3.exp(jnp.append(tilt, 0.0)).as_matrix()
    fovy = camera.fovy * _uniform(scale_key, (), _SCALE_RANGE)
    return camera.replace(rotation=camera.rotation @ turn, fovy=fovy)  # pyright: ignore[reportAttributeAccessIssue] # flax adds it


def augment_input(key: Array, x: Array, is_object: Array, config: Config) -> Array:
    """Returns the network's input with the faults that the encoder must learn to ignore.

    Every input gets another background in half of the cases, and occlusions. rgb then gets another hue, saturation,
    contrast and brightness; depth gets noise and holes; a silhouette gets spots on and off the object.

    Args:
      key: PRNG key.
      x: f32[H, W, C] in [0, 1] from `network_input`.
      is_object: bool[H, W], where the object is.
      config: the run's.

    Returns:
      f32[H, W, C] in [0, 1].
    """
    background_key, occlusion_key, sensor_key = jax.random.split(key, 3)
    if config.encoder.input == "silhouette":
        return _spoil_silhouette(sensor_key, jnp.round(occlude(occlusion_key, x)))
    x = occlude(occlusion_key, replace_background(background_key, x, is_object))
    spoil = _spoil_rgb if config.encoder.input == "rgb" else _spoil_depth
    return jnp.clip(spoil(sensor_key, x), 0.0, 1.0)


def clean_target(x: Array, is_object: Array, config: Config) -> Array:
    """Returns what the decoder is to draw: `x` (f32[h, w, C]) with all but the object black, or far for depth."""
    blank = 1.0 if config.encoder.input == "depth" else 0.0
    return jnp.where(is_object[..., None], x, blank)


def replace_background(key: Array, x: Array, is_object: Array) -> Array:
    """Returns `x` (f32[H, W, C]), in half of the cases with a texture where `is_object` (bool[H, W]) is false."""
    choice_key, texture_key = jax.random.split(key)
    is_replaced = jax.random.bernoulli(choice_key, _BACKGROUND_PROBABILITY)
    return jnp.where(is_replaced & ~is_object[..., None], _texture(texture_key, x.shape), x)


def occlude(key: Array, x: Array) -> Array:
    """Returns `x` (f32[H, W, C]) with up to two rectangles of random place, size and colour."""
    height, width, features = x.shape
    numbers = jax.random.uniform(key, (_NUM_OCCLUSIONS, 5 + features))
    for is_there, row, column, half_height, half_width, *color in numbers:
        rows = jnp.abs(_pixel_centers(height) - row) < 0.5 * _MAX_OCCLUSION * half_height
        columns = jnp.abs(_pixel_centers(width) - column) < 0.5 * _MAX_OCCLUSION * half_width
        is_inside = rows[:, None] & columns[None, :] & (is_there < _OCCLUSION_PROBABILITY)
        x = jnp.where(is_inside[..., None], jnp.stack(color)[None, None], x)
    return x


def _spoil_rgb(key: Array, x: Array) -> Array:
    color_key, contrast_key, brightness_key = jax.random.split(key, 3)
    x = x @ _color_matrix(color_key)
    contrasted = dm_pix.random_contrast(contrast_key, x, *_CONTRAST_RANGE)
    return jnp.asarray(dm_pix.random_brightness(brightness_key, contrasted, _MAX_BRIGHTNESS))


def _color_matrix(key: Array) -> Array:
    """Returns f32[3, 3], by which a pixel's rgb is multiplied from the right to turn its hue and scale its saturation.

    Hue turns about the grey axis, saturation scales across it, so that grey stays. dm-pix goes by way of HSV, which XLA
    on CPU evaluates anew for each use: with it, `augment_input` takes 15 times as long.
    """
    hue_key, saturation_key = jax.random.split(key)
    angle = _MAX_HUE * jax.random.uniform(hue_key, minval=-1.0, maxval=1.0)
    saturation = _uniform(saturation_key, (), _SATURATION_RANGE)
    grey = jnp.full((3, 3), 1.0 / 3.0)
    turn = SO3.exp(angle * jnp.full(3, 3.0**-0.5)).as_matrix()
    return grey + saturation * (turn - grey)


def _spoil_depth(key: Array, x: Array) -> Array:
    """Adds noise in patches, as a stereo sensor's, and holes, which such sensors report as far."""
    noise_key, hole_key = jax.random.split(key)
    x = x + _DEPTH_NOISE * (2.0 * _noise(noise_key, x.shape, _NOISE_GRID) - 1.0)
    return jnp.where(_spots(hole_key, x.shape), 1.0, x)


def _spoil_silhouette(key: Array, x: Array) -> Array:
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
    """Returns noise in [0, 1] on a grid, linear between: a number for every pixel takes longer than encoding it."""
    return jax.image.resize(jax.random.uniform(key, (grid, grid, shape[-1])), shape, "linear")


def _pixel_centers(count: int) -> Array:
    return (jnp.arange(count, dtype=jnp.float32) + 0.5) / count


def _uniform(key: Array, shape: tuple[int, ...], limits: tuple[float, float]) -> Array:
    return jax.random.uniform(key, shape, minval=limits[0], maxval=limits[1])
