"""Points on the surface of an object."""

import mujoco
import numpy as np
import pytest
import trimesh

from vsearch_jax.config import SceneConfig
from vsearch_jax.scene import build_scene
from vsearch_jax.scene.surface import surface_points


@pytest.mark.parametrize(
    ("geom", "solid"),
    [
        ('type="box" size=".1 .2 .3"', trimesh.creation.box((0.2, 0.4, 0.6))),
        ('type="sphere" size=".1"', trimesh.creation.icosphere(subdivisions=4, radius=0.1)),
        ('type="cylinder" size=".1 .3"', trimesh.creation.cylinder(0.1, 0.6, sections=200)),
        ('type="capsule" size=".1 .3"', trimesh.creation.capsule(0.6, 0.1, count=[100, 100])),
        (
            'type="ellipsoid" size=".1 .2 .3"',
            trimesh.creation.icosphere(subdivisions=4).apply_scale((0.1, 0.2, 0.3)),
        ),
    ],
    ids=lambda x: x.split('"')[1] if isinstance(x, str) else "",
)
def test_points_of_the_surface_lie_as_far_out_as_the_solid_in_every_direction(geom, solid) -> None:
    model = mujoco.MjModel.from_xml_string(
        f'<mujoco><worldbody><geom {geom} pos="1 2 3" euler="20 30 40"/></worldbody></mujoco>'
    )
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    vertices = solid.vertices @ data.geom_xmat[0].reshape(3, 3).T + data.geom_xpos[0]
    directions = np.random.default_rng(0).normal(size=(100, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    ours, theirs = ((points @ directions.T).max(axis=0) for points in (surface_points(model, [0]), vertices))
    np.testing.assert_allclose(ours, theirs, atol=0.006)  # round shapes are meshes of few faces


def test_shapes_that_no_camera_sees_are_no_part_of_the_surface(tmp_path) -> None:
    path = tmp_path / "part.xml"
    ball, box = '<geom type="sphere" size=".05" pos="0 0 .05"/>', '<geom type="box" size=".1 .1 .1" group="3"/>'
    path.write_text(f"<mujoco><worldbody><body>{ball}{box}</body></worldbody></mujoco>")
    points = build_scene(SceneConfig(object=str(path))).object_points
    np.testing.assert_allclose(
        [points.min(axis=0), points.max(axis=0)], [[-0.05, -0.05, 0], [0.05, 0.05, 0.1]], atol=0.001
    )
