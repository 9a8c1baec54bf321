"""Derivatives of a whole picture against central differences, parameter by parameter."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from jaxlie import SO3

from oracles.render import forward, on_outline, poses
from vsearch_jax import render

SIZE = (48, 48)
STEP = 1e-3
# Curved and flat geoms over a plane, under a spot light, a point light and a directional one; nothing hides another.
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


@pytest.fixture(scope="module")
def rates():
    """Derivatives, central differences and the pixels where both are of the same surface, by parameter."""
    model = mujoco.MjModel.from_xml_string(SCENE)
    frames, scene = poses(model, forward(model)), render.compile_scene(model).replace(has_shadows=False)
    eye = render.camera(frames, model, "eye")

    def picture(change: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        parts = jnp.split(change, np.cumsum(list(PARAMETERS.values()))[:-1])
        part = dict(zip(PARAMETERS, parts, strict=True))
        camera = eye.replace(
            position=eye.position + part["camera position"],
            rotation=eye.rotation @ SO3.exp(part["camera rotation"]).as_matrix(),
            fovy=eye.fovy + part["field of view"][0],
        )
        turned = SO3.exp(part["geom rotation"]).as_matrix()[None] @ frames.geom_xmat
        is_moved = np.float32(np.arange(model.ngeom) > 0)[:, None]
        moved = frames._replace(
            geom_xpos=frames.geom_xpos + is_moved * part["geom position"][None],
            geom_xmat=jnp.where(is_moved[..., None] > 0.0, turned, frames.geom_xmat),
        )
        lights = scene.lights.replace(
            position=scene.lights.position + part["light position"][None],
            direction=scene.lights.direction + part["light direction"][None],
            diffuse=scene.lights.diffuse + part["light diffuse"][None],
        )
        lit = scene.replace(rgb=scene.rgb + part["geom colour"][None], lights=lights)
        image = render.render(lit, moved, camera, SIZE)
        return jnp.where(image.geom_id >= 0, image.depth, 0.0)[..., None], image.rgb, image.geom_id

    ways = jnp.eye(sum(PARAMETERS.values()))
    ends = jax.jit(jax.vmap(picture))(STEP * jnp.concatenate([ways, -ways]))
    slopes = jax.jit(jax.vmap(lambda way: jax.jvp(picture, (jnp.zeros_like(way),), (way,))[1][:2]))(ways)
    differences = [np.subtract(*np.split(np.asarray(value), 2)) / (2 * STEP) for value in ends[:2]]
    is_same = ~np.array([on_outline(ids) for ids in np.asarray(ends[2])])
    is_same = np.logical_and(*np.split(is_same, 2)) & np.equal(*np.split(np.asarray(ends[2]), 2))
    return [np.asarray(slope) for slope in slopes], differences, is_same


@pytest.mark.parametrize("name", PARAMETERS)
def test_derivatives_equal_central_differences(rates, name: str) -> None:
    first = sum(list(PARAMETERS.values())[: list(PARAMETERS).index(name)])
    part = slice(first, first + PARAMETERS[name])
    is_of_light = name.startswith("light") or name == "geom colour"
    for what, slopes, differences in zip(("depth", "rgb"), rates[0], rates[1], strict=True):
        slope, difference, is_same = slopes[part], differences[part], rates[2][part]
        assert np.isfinite(slope).all()
        assert is_same.mean() > 0.7
        if what == "depth" and is_of_light:
            assert not slope.any()
            continue
        assert np.abs(difference[is_same]).max() > 0.05, f"{what} does not depend on it"
        error = np.abs(slope - difference)[is_same]
        # A difference quotient in f32 is good to about 1e-3; the edges of the box and the cylinder are not smooth.
        assert np.mean(error < 5e-3 + 0.02 * np.abs(difference[is_same])) > 0.97, what
