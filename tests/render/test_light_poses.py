"""Poses of lights of all modes, on moving, welded and mocap bodies, against `mj_camlight`."""

from __future__ import annotations

import itertools

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from oracles.render import forward
from vsearch_jax import render
from vsearch_jax.render.lights import light_poses
from vsearch_jax.types import Camera

MODES = ("fixed", "track", "trackcom", "targetbody", "targetbodycom")
WORLD_CAMERA = Camera(jnp.zeros(3), jnp.eye(3), jnp.float32(1.0))


def _model(modes: tuple[str, ...]) -> mujoco.MjModel:
    """Returns a model whose bodies and world carry lights of all modes and types, with names of mode and carrier."""
    number = itertools.count()

    def lights(carrier: str) -> str:
        return "".join(
            f'<light name="{mode} {carrier}" mode="{mode}" pos=".3 {0.1 * next(number):.1f} .7" dir=".2 -.4 -1" '
            f'type="{kind}" target="{target}"/>'
            for mode, (kind, target) in zip(modes, itertools.cycle((("spot", "tip"), ("directional", "floor"))))
        )

    return mujoco.MjModel.from_xml_string(f"""
      <mujoco><worldbody>{lights("world")}
        <body name="floor" pos=".2 .1 0"><geom size=".1" mass="2"/>{lights("floor")}</body>
        <body name="hand" mocap="true" pos="0 .5 .2"><geom size=".1"/>{lights("hand")}</body>
        <body name="base" pos=".1 .2 .3"><freejoint/><geom size=".1" pos=".2 0 .1" mass="1.5"/>{lights("base")}
          <body name="arm" pos=".3 0 0"><joint axis="1 .4 0"/><geom size=".1" pos="0 .3 0" mass=".5"/>
            <body name="tip" pos="0 .2 .1"><joint axis="0 1 0"/><geom size=".05" mass=".7"/>{lights("tip")}
              <body name="mark" pos="0 0 .4">{lights("mark")}</body></body></body></body>
      </worldbody></mujoco>""")


def _moved(model: mujoco.MjModel, seed: int) -> mujoco.MjData:
    rng, data = np.random.default_rng(seed), mujoco.MjData(model)
    data.qpos[:] = rng.normal(size=model.nq)
    data.mocap_pos[:], data.mocap_quat[:] = rng.normal(size=3), rng.normal(size=4)
    mujoco.mj_forward(model, data)
    return data


@pytest.mark.parametrize("seed", range(3))
def test_lights_of_all_modes_equal_mujocos(seed: int) -> None:
    model = _model(MODES)
    lights = render.compile_scene(model).lights
    data = _moved(model, seed)
    poses = light_poses(lights, data, WORLD_CAMERA)
    np.testing.assert_allclose(poses.position, data.light_xpos, atol=2e-5)
    np.testing.assert_allclose(poses.direction, data.light_xdir, atol=2e-5)


def test_cameras_of_all_modes_are_those_of_the_data() -> None:
    model = mujoco.MjModel.from_xml_string(_camera_model())
    data = forward(model)
    data.qpos[:3] = [0.4, -0.3, 0.2]
    mujoco.mj_forward(model, data)
    for number in range(model.ncam):
        camera = render.camera(render.poses(data), model, number)
        np.testing.assert_allclose(camera.position, data.cam_xpos[number], atol=1e-6)
        np.testing.assert_allclose(camera.rotation, data.cam_xmat[number].reshape(3, 3), atol=1e-6)


def _camera_model() -> str:
    cameras = "".join(f'<camera mode="{mode}" target="ball" pos="0 {i}.5 1"/>' for i, mode in enumerate(MODES))
    return f"""<mujoco><worldbody><geom size=".1"/><body name="ball"><freejoint/><geom size=".1"/>{cameras}</body>
      <camera mode="targetbody" target="ball" pos="1 1 1"/></worldbody></mujoco>"""
