"""Tests of the overview camera."""

import mujoco
import numpy as np
import pytest

from vsearch_jax.config import SceneConfig
from vsearch_jax.film.overview import overview_camera
from vsearch_jax.scene import build_scene


@pytest.mark.parametrize(("arm", "height"), [("lwr", 1.355), ("ur5e", 1.0), ("lwr", 3.0)])
@pytest.mark.parametrize("size", [(72, 64), (64, 200)])
def test_arm_mount_and_object_fill_the_overview(arm: str, height: float, size: tuple[int, int]) -> None:
    scene = build_scene(SceneConfig(arm=arm, mount_height=height))
    model, random = scene.mj_model, np.random.default_rng(0)
    lower, upper = model.jnt_range.T
    qpos = random.uniform(lower, upper, (40, model.nq))
    camera = overview_camera(scene, qpos, size)
    data = mujoco.MjData(model)
    slopes = []
    for configuration in qpos:
        data.qpos[:] = configuration
        mujoco.mj_kinematics(model, data)
        geoms = [*scene.arm_geom_ids, *scene.mount_geom_ids, *scene.object_geom_ids]
        x, y, z = ((data.geom_xpos[geoms] - np.asarray(camera.position)) @ np.asarray(camera.rotation)).T
        assert z.max() < 0.0
        # The centres of all geoms are in view.
        slopes.append((np.abs(x / z).max(), np.abs(y / z).max()))
    half = np.tan(float(camera.fovy) / 2)
    largest = np.max(slopes, axis=0) / (half * size[1] / size[0], half)
    assert largest.max() < 1.0
    assert largest.max() > 0.7
