"""Pose errors of symmetric objects: those to the nearest pose from which the object looks the same."""

from __future__ import annotations

import math

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from vsearch_jax.env import pose_error
from vsearch_jax.geometry import view_pose
from vsearch_jax.types import Camera, View

CENTER, RADIUS = np.array([0.02, -0.01, 0.05]), 0.35


def camera_at(azimuth_deg: float, elevation_deg: float) -> Camera:
    view = View(jnp.radians(jnp.float32(azimuth_deg)), jnp.radians(jnp.float32(elevation_deg)))
    pose = view_pose(view, jnp.asarray(CENTER, jnp.float32), RADIUS)
    return Camera(pose.translation(), pose.rotation().as_matrix(), jnp.float32(0.8))


@pytest.mark.parametrize("order", [1, 2, 3, 6])
@pytest.mark.parametrize("azimuth", [0.0, 35.0, 100.0, 178.0])
def test_errors_are_the_smallest_over_all_turns_of_the_object(order, azimuth):
    camera, target = camera_at(azimuth, 45.0), camera_at(5.0, 52.0)
    rotations, translations = [], []
    for angle in np.arange(order) * (2.0 * math.pi / order):
        turn = Rotation.from_euler("z", angle)
        turned = turn * Rotation.from_matrix(np.asarray(target.rotation))
        rotations.append((Rotation.from_matrix(np.asarray(camera.rotation)).inv() * turned).magnitude())
        position = CENTER + turn.apply(np.asarray(target.position) - CENTER)
        translations.append(np.linalg.norm(np.asarray(camera.position) - position))
    best = int(np.argmin(rotations))
    rotation, _, translation = pose_error(camera, target, order, jnp.asarray(CENTER, jnp.float32))
    assert float(rotation) == pytest.approx(rotations[best], abs=1e-3)
    assert float(translation) == pytest.approx(translations[best], abs=1e-4)


def test_a_turned_view_of_a_body_of_revolution_differs_by_its_elevation_only():
    rotation, _, translation = pose_error(camera_at(130.0, 60.0), camera_at(-20.0, 50.0), 0, jnp.float32(CENTER))
    assert float(rotation) == pytest.approx(math.radians(10.0), abs=1e-3)
    assert float(translation) == pytest.approx(2.0 * RADIUS * math.sin(math.radians(5.0)), abs=1e-4)
