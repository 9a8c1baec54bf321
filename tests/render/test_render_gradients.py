"""Derivatives of whole images against central differences."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from jaxlie import SO3

from oracles.render import Poses, forward, on_outline, poses, random_scene
from vsearch_jax import render

SIZE = (48, 48)
STEP = 1e-3
# Curved and flat geoms over a plane, with a spot light, a point light and a directional light. No geom hides another.
SCENE = """
<mujoco><visual><headlight ambient=".1 .1 .1" diffuse=".2 .2 .2" specular=".1 .1 .1"/></visual><worldbody>
  <geom type="plane" size="0 0 1" rgba=".6 .5 .4 1"/>
  <geom type="ellipsoid" size=".2 .15 .12" pos="-.35 .3 .2" rgba=".8 .3 .2 1"/>
  <geom type="capsule" size=".1 .15" pos=".35 .3 .2" euler="60 20 0" rgba=".2 .7 .3 1"/>
  <geom type="cylinder" size=".15 .1" pos="-.35 -.3 .2" euler="30 10 0" rgba=".3 .3 .8 1"/>
  <geom type="box" size=".15 .12 .1" pos=".35 -.3 .2" euler="20 30 40" rgba=".7 .7 .2 1"/>
  <light name="spot" type="spot" pos="-.5 .6 1.5" dir=".3 -.3 -1" cutoff="60" exponent="5"
    diffuse=".5 .5 .4" specular=".2 .2 .2"/>
  <light name="lamp" type="point" pos=".8 .1 1.2" diffuse=".3 .2 .3" attenuation="1 .1 .2"/>
  <light name="sun" type="directional" dir=".2 .3 -1" diffuse=".2 .2 .2"/>
  <camera name="eye" pos=".1 -.1 2.2" euler="3 4 10" fovy="40"/>
</worldbody></mujoco>
"""
# Number of values of each parameter.
PARAMETERS = {
    "camera position": 3,
    "camera rotation": 3,
    "field of view": 1,
    "geom position": 3,
    "geom rotation": 3,
    "geom colour": 3,
    "light position": 3,
    "light direction": 3,
    "light diffuse": 3,
}

Planes = tuple[jax.Array, jax.Array, jax.Array]


def _planes(image: render.Image) -> Planes:
    """Returns depth (0 on a miss), rgb and geom_id."""
    return jnp.where(image.geom_id >= 0, image.depth, 0.0), image.rgb, image.geom_id


def _render_changed(scene: render.RenderScene, frames: Poses, eye: render.Camera, change: jax.Array) -> Planes:
    """Renders with `change` added to the parameters, f32[25] in the order of `PARAMETERS`."""
    parts = jnp.split(change, np.cumsum(list(PARAMETERS.values()))[:-1])
    part = dict(zip(PARAMETERS, parts, strict=True))
    camera = eye.replace(
        position=eye.position + part["camera position"],
        rotation=eye.rotation @ SO3.exp(part["camera rotation"]).as_matrix(),
        fovy=eye.fovy + part["field of view"][0],
    )
    rotated = SO3.exp(part["geom rotation"]).as_matrix()[None] @ frames.geom_xmat
    is_movable = np.float32(np.arange(len(frames.geom_xpos)) > 0)[:, None]  # all but the plane
    moved = frames._replace(
        geom_xpos=frames.geom_xpos + is_movable * part["geom position"][None],
        geom_xmat=jnp.where(is_movable[..., None] > 0.0, rotated, frames.geom_xmat),
    )
    lights = scene.lights.replace(
        position=scene.lights.position + part["light position"][None],
        direction=scene.lights.direction + part["light direction"][None],
        diffuse=scene.lights.diffuse + part["light diffuse"][None],
    )
    lit = scene.replace(rgb=scene.rgb + part["geom colour"][None], lights=lights)
    return _planes(render.render(lit, moved, camera, SIZE))


@pytest.fixture(scope="module")
def rates() -> tuple[list[np.ndarray], list[np.ndarray], np.ndarray]:
    """Returns derivatives and central differences of depth and rgb, and the pixels where both are of one surface.

    The leading axis runs over the 25 parameters.
    """
    model = mujoco.MjModel.from_xml_string(SCENE)
    frames, scene = poses(model, forward(model)), render.compile_scene(model).replace(has_shadows=False)
    eye = render.camera(frames, model, "eye")

    def draw(change: jax.Array) -> Planes:
        return _render_changed(scene, frames, eye, change)

    directions = jnp.eye(sum(PARAMETERS.values()))
    ends = jax.jit(jax.vmap(draw))(STEP * jnp.concatenate([directions, -directions]))
    slopes = jax.jit(jax.vmap(lambda d: jax.jvp(draw, (jnp.zeros_like(d),), (d,))[1][:2]))(directions)
    depth_slopes, rgb_slopes = (np.asarray(slope) for slope in slopes)
    differences = [np.subtract(*np.split(np.asarray(value), 2)) / (2 * STEP) for value in ends[:2]]
    is_inside = ~np.array([on_outline(ids) for ids in np.asarray(ends[2])])
    is_same = np.logical_and(*np.split(is_inside, 2)) & np.equal(*np.split(np.asarray(ends[2]), 2))
    return [depth_slopes[..., None], rgb_slopes], [differences[0][..., None], differences[1]], is_same


@pytest.mark.parametrize("name", PARAMETERS)
def test_derivatives_equal_central_differences(rates, name: str) -> None:
    first = sum(list(PARAMETERS.values())[: list(PARAMETERS).index(name)])
    part = slice(first, first + PARAMETERS[name])
    is_of_light = name.startswith("light") or name == "geom colour"
    for plane, slopes, differences in zip(("depth", "rgb"), rates[0], rates[1], strict=True):
        slope, difference, is_same = slopes[part], differences[part], rates[2][part]
        assert np.isfinite(slope).all()
        assert is_same.mean() > 0.7
        if plane == "depth" and is_of_light:
            assert not slope.any()
            continue
        assert np.abs(difference[is_same]).max() > 0.05, f"{plane} does not depend on {name}"
        error = np.abs(slope - difference)[is_same]
        # A central difference in f32 has an error of about 1e-3. Edges of the box and the cylinder are not smooth.
        assert np.mean(error < 5e-3 + 0.02 * np.abs(difference[is_same])) > 0.97, plane


def test_gradients_of_a_random_scene_are_finite_and_equal_central_differences() -> None:
    model, size = random_scene(np.random.default_rng(3), num_geoms=10), (24, 24)
    frames, scene = poses(model, forward(model)), render.compile_scene(model)
    eye = render.camera(frames, model, "eye")

    def draw(position: jax.Array) -> Planes:
        return _planes(render.render(scene, frames, eye.replace(position=position), size))

    def total(position: jax.Array, geom_size: jax.Array, xpos: jax.Array, xmat: jax.Array) -> jax.Array:
        moved = frames._replace(geom_xpos=xpos, geom_xmat=xmat)
        image = render.render(scene.replace(size=geom_size), moved, eye.replace(position=position), size)
        return jnp.sum(_planes(image)[0]) + jnp.sum(image.rgb)

    arguments = (eye.position, scene.size, jnp.asarray(frames.geom_xpos), jnp.asarray(frames.geom_xmat))
    gradients = jax.jit(jax.grad(total, argnums=(0, 1, 2, 3)))(*arguments)
    assert all(bool(jnp.all(jnp.isfinite(g))) and float(jnp.abs(g).max()) > 0.0 for g in gradients)

    direction = jnp.array([0.3, -0.5, 0.8])
    ends = jax.jit(jax.vmap(draw))(eye.position[None] + STEP * jnp.array([[-1.0], [1.0]]) * direction[None])
    (depth, rgb, ids), rates_of = jax.jit(lambda p: jax.jvp(draw, (p,), (direction,)))(eye.position)
    interior = ~on_outline(np.asarray(ids)) & np.all(np.asarray(ends[2]) == np.asarray(ids), axis=0)
    for value, rate in zip(ends[:2], rates_of[:2], strict=True):
        difference = np.asarray((value[1] - value[0]) / (2 * STEP))
        error = np.abs(np.asarray(rate) - difference)[interior]
        # Edges of boxes and of shadows are not smooth. A central difference in f32 has an error of about 1e-3.
        assert np.mean(error < 5e-3 + 0.01 * np.abs(difference[interior])) > 0.9
    assert depth.shape == size and rgb.shape == (*size, 3)


def test_derivatives_of_materials_and_headlight_equal_central_differences() -> None:
    model = mujoco.MjModel.from_xml_string(
        '<mujoco><worldbody><geom size=".5"/><camera name="eye" pos="0 0 2" fovy="50"/></worldbody></mujoco>'
    )
    frames = render.poses(forward(model))
    camera, scene = render.camera(frames, model, "eye"), render.compile_scene(model)
    glossy = scene.replace(specular=scene.specular * 0.5, shininess=scene.shininess * 0.1)

    def brightness(change: jax.Array, name: str) -> jax.Array:
        changed = glossy.replace(**{name: getattr(glossy, name) + change})
        return render.render(changed, frames, camera, (24, 32)).rgb.sum()

    for name in ("rgb", "specular", "shininess", "emission", "headlight_diffuse", "headlight_ambient"):
        step = np.float32(1.0 if name == "shininess" else 1e-2)
        value = jax.jit(jax.value_and_grad(lambda change, name=name: brightness(change, name)))
        slope = value(np.float32(0.0))[1]
        difference = (value(step)[0] - value(-step)[0]) / (2 * step)
        assert np.abs(difference) > 1e-3, name
        np.testing.assert_allclose(slope, difference, rtol=2e-2, err_msg=name)
