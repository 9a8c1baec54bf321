"""Camera poses on the view sphere, rotation errors and code similarity, against SciPy and closed forms."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from jax import Array
from jaxlie import SE3
from scipy.spatial.transform import Rotation

from vsearch_jax import geometry
from vsearch_jax.types import View

ANGLES = st.floats(-3.1, 3.1)
CENTER, RADIUS = jnp.asarray([0.1, -0.2, 0.05]), 0.35


def _view_pose(azimuth: float, elevation: float) -> SE3:
    return geometry.view_pose(View(jnp.float32(azimuth), jnp.float32(elevation)), CENTER, RADIUS)


@given(ANGLES, st.floats(-1.5, 1.5))
def test_camera_looks_at_the_center_with_a_horizontal_x_axis(azimuth: float, elevation: float) -> None:
    T_world_camera = _view_pose(azimuth, elevation)
    rotation, position = T_world_camera.rotation().as_matrix(), T_world_camera.translation()
    np.testing.assert_allclose(position - RADIUS * rotation[:, 2], CENTER, atol=1e-6)
    assert abs(float(rotation[2, 0])) < 1e-6
    assert float(rotation[2, 1]) >= -1e-6, "the image is upside down"
    np.testing.assert_allclose(np.linalg.det(rotation), 1.0, atol=1e-5)
    offset = np.asarray(position - CENTER)
    np.testing.assert_allclose(np.arcsin(np.clip(offset[2] / RADIUS, -1, 1)), elevation, atol=2e-3)
    np.testing.assert_allclose(np.exp(1j * np.arctan2(offset[1], offset[0])), np.exp(1j * azimuth), atol=1e-4)


def test_pose_at_the_pole_is_the_limit_along_the_meridian() -> None:
    at_pole, near_pole = _view_pose(0.7, np.pi / 2), _view_pose(0.7, np.pi / 2 - 1e-4)
    np.testing.assert_allclose(at_pole.as_matrix(), near_pole.as_matrix(), atol=2e-4)


@given(st.lists(ANGLES, min_size=3, max_size=3), st.lists(ANGLES, min_size=3, max_size=3))
def test_rotation_error_equals_the_magnitude_of_scipy(a: list[float], b: list[float]) -> None:
    first, second = Rotation.from_rotvec(a), Rotation.from_rotvec(b)
    expected = (first.inv() * second).magnitude()
    measured = geometry.rotation_error(jnp.float32(first.as_matrix()), jnp.float32(second.as_matrix()))
    np.testing.assert_allclose(measured, expected, atol=2e-3)


@pytest.mark.parametrize("angle", [1e-5, 1e-3, 0.05, 1.0, 3.0, np.pi])
def test_rotation_error_is_precise_for_small_and_large_angles(angle: float) -> None:
    rotation = jnp.float32(Rotation.from_rotvec([0.0, angle, 0.0]).as_matrix())
    np.testing.assert_allclose(geometry.rotation_error(jnp.eye(3), rotation), angle, rtol=1e-3)


@pytest.mark.parametrize("error", [geometry.rotation_error, geometry.frobenius_angle])
@pytest.mark.parametrize("angle", [0.0, np.pi])
def test_gradients_of_rotation_errors_are_finite_at_degenerate_angles(
    error: Callable[[Array, Array], Array], angle: float
) -> None:
    rotation = jnp.float32(Rotation.from_rotvec([0.0, 0.0, angle]).as_matrix())
    assert np.isfinite(jax.grad(error)(rotation, jnp.eye(3))).all()


def test_frobenius_angle_equals_formula_3_2() -> None:
    rotation = jnp.float32(Rotation.from_rotvec([0.0, 0.0, 0.5]).as_matrix())
    np.testing.assert_allclose(
        geometry.frobenius_angle(jnp.eye(3), rotation), np.arccos((1 + 2 * np.cos(0.5)) / 3), rtol=1e-5
    )


@given(ANGLES, ANGLES)
def test_angle_difference_is_the_shortest_rotation(a: float, b: float) -> None:
    difference = float(geometry.angle_difference(jnp.float32(a), jnp.float32(b)))
    assert -np.pi - 1e-5 <= difference <= np.pi + 1e-5
    np.testing.assert_allclose(np.exp(1j * (b + difference)), np.exp(1j * a), atol=1e-4)


def test_cosine_similarity_of_a_zero_code_is_zero_with_a_finite_gradient() -> None:
    code, zero = jnp.arange(4.0), jnp.zeros(4)
    assert float(geometry.cosine_similarity(code, zero)) == 0.0
    assert np.isfinite(jax.grad(geometry.cosine_similarity)(zero, code)).all()
    np.testing.assert_allclose(geometry.cosine_similarity(code, 3.0 * code), 1.0, rtol=1e-6)


ANY_ANGLE = st.floats(-20.0, 20.0, width=32)


@given(ANY_ANGLE, st.floats(0.0, 1.0, width=32), st.floats(0.0, 0.5, width=32))
def test_an_elevation_is_reflected_into_the_band(elevation, low, height):
    band = jnp.asarray([low, low + height], jnp.float32)
    folded = geometry.fold_into_band(jnp.asarray(elevation, jnp.float32), band)
    assert float(band[0]) <= float(folded) <= float(band[1])
    np.testing.assert_allclose(geometry.fold_into_band(folded, band), folded, atol=1e-5)
    if height > 0.1:
        # Reflection keeps the cosine of the phase.
        phase = np.pi * (elevation - low) / height
        phase_folded = np.pi * (float(folded) - low) / height
        assert np.cos(phase_folded) == pytest.approx(np.cos(phase), abs=2e-3)


@pytest.mark.parametrize("order", [2, 5, 0])
def test_the_turn_of_a_symmetric_object_brings_the_rotations_as_near_as_the_best_of_all_turns(order):
    first, second = (Rotation.random(20, random_state=seed) for seed in (1, 2))
    turn = geometry.symmetric_turn(*(jnp.float32(x.as_matrix()) for x in (first, second)), order)
    turned = geometry.turn_about_z(turn) @ jnp.float32(second.as_matrix())
    ours = geometry.rotation_error(jnp.float32(first.as_matrix()), turned)
    turns = np.linspace(0.0, 2.0 * np.pi, order or 3600, endpoint=False)
    angles = [(first.inv() * Rotation.from_euler("z", angle) * second).magnitude() for angle in turns]
    np.testing.assert_allclose(ours, np.min(angles, axis=0), atol=2e-3)
    if order:
        np.testing.assert_allclose(np.round(turn / turns[1]), turn / turns[1], atol=1e-4)
