"""Measures of one search: errors of symmetric objects, and the largest error on the object's surface."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from vsearch_jax.config import Config
from vsearch_jax.evaluation.outcome import measure_outcome
from vsearch_jax.geometry import view_pose
from vsearch_jax.types import Camera, Observation, SearchResult, View

CENTER, RADIUS = np.array([0.02, -0.01, 0.05]), 0.35
POINTS = CENTER + np.random.default_rng(0).uniform(-0.1, 0.1, (50, 3))


def camera_at(azimuth_deg: float, elevation_deg: float) -> Camera:
    view = View(jnp.radians(jnp.float32(azimuth_deg)), jnp.radians(jnp.float32(elevation_deg)))
    pose = view_pose(view, jnp.asarray(CENTER, jnp.float32), RADIUS)
    return Camera(pose.translation(), pose.rotation().as_matrix(), jnp.float32(0.8))


def outcome(camera: Camera, target: Camera, symmetry: int) -> dict[str, Any]:
    """Returns the measures of a search that met the threshold with `camera`, for an object of that symmetry."""
    scene = SimpleNamespace(symmetry=symmetry, object_points=POINTS)
    env: Any = SimpleNamespace(scene=scene, center=jnp.asarray(CENTER, jnp.float32), config=Config.preset("smoke"))
    zero = jnp.float32(0.0)
    result = SearchResult(View(zero, zero), jnp.float32(0.99), jnp.zeros(1), jnp.int32(3), jnp.int32(0))
    final, wanted = (Observation(View(zero, zero), jnp.zeros(2), one, jnp.zeros(4)) for one in (camera, target))
    return measure_outcome(env, result, final, wanted)


def in_camera(camera: Camera, points: np.ndarray) -> np.ndarray:
    return Rotation.from_matrix(np.asarray(camera.rotation)).inv().apply(points - np.asarray(camera.position))


@pytest.mark.parametrize(("azimuth", "symmetry"), [(0.0, 1), (20.0, 1), (180.0, 1), (120.0, 2), (178.0, 2), (50.0, 5)])
def test_the_surface_distance_is_the_largest_over_the_points_and_the_smallest_over_the_turns(azimuth, symmetry):
    camera, target = camera_at(azimuth, 48.0), camera_at(0.0, 55.0)
    distances = []
    for number in range(symmetry):
        turned = CENTER + Rotation.from_euler("z", 2 * np.pi * number / symmetry).apply(POINTS - CENTER)
        distances.append(np.linalg.norm(in_camera(camera, POINTS) - in_camera(target, turned), axis=1).max())
    assert float(outcome(camera, target, symmetry)["surface_distance"]) == pytest.approx(min(distances), abs=1e-5)


@pytest.mark.parametrize(("symmetry", "is_wrong"), [(1, True), (2, False), (3, True), (4, False), (0, False)])
def test_the_other_side_of_an_object_is_the_right_view_if_the_object_is_symmetric(symmetry, is_wrong):
    measures = outcome(camera_at(180.0, 50.0), camera_at(0.0, 50.0), symmetry)
    assert bool(measures["is_false_positive"]) == is_wrong
    for name, limit in (("rotation_error", 1e-3), ("translation_error", 1e-4), ("surface_distance", 1e-4)):
        assert (float(measures[name]) > limit) == is_wrong
