"""Ray and chord functions of the primitives against C MuJoCo's `mju_rayGeom`."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mujoco import mjtGeom

from oracles.render import random_size
from vsearch_jax.render.geometry.rays import CHORD_FUNCTIONS, RAY_FUNCTIONS

# f32 against C MuJoCo's f64. At a distance of 1 m, a discriminant of r^2 is rounded at 1e-7, so its root is off by
# 1e-7 / r: about 1e-5 for radii of 0.05 m, if the ray does not graze.
RAY_TOLERANCE = 1e-4
# A ray grazes a solid if it hits the solid of one size and misses it of a size larger or smaller by this fraction. Both
# answers are then correct.
GRAZE = 1e-3
SEEDS = st.integers(0, 2**31)

_RAYS = {kind: jax.jit(function) for kind, function in RAY_FUNCTIONS.items()}
_CHORDS = {kind: jax.jit(function) for kind, function in CHORD_FUNCTIONS.items()}


def _vector(vectors: np.ndarray) -> tuple[jax.Array, jax.Array, jax.Array]:
    x, y, z = (jnp.asarray(v, dtype=jnp.float32) for v in np.moveaxis(vectors, -1, 0))
    return x, y, z


def _mju_ray_geom(kind: int, size: np.ndarray, points: np.ndarray, directions: np.ndarray) -> np.ndarray:
    identity = np.eye(3).reshape(9)
    distances = [
        mujoco.mju_rayGeom(np.zeros(3), identity, size, p, d, kind) for p, d in zip(points, directions, strict=True)
    ]
    return np.where(np.array(distances) < 0.0, np.inf, distances)


def _random_rays(rng: np.random.Generator, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Returns origins, half of them near the solid and half outside, and directions of any length."""
    points = rng.normal(size=(count, 3)) * np.where(np.arange(count) % 2, 0.2, 1.5)[:, None]
    targets = rng.normal(size=(count, 3)) * 0.3
    directions = (targets - points) * rng.uniform(0.3, 3.0, size=(count, 1))
    directions[: count // 8, rng.integers(3)] = 0.0  # parallel to a face
    return points, directions


@pytest.mark.parametrize("kind", sorted(RAY_FUNCTIONS), ids=lambda kind: mjtGeom(kind).name)
@given(seed=SEEDS)
@settings(max_examples=12)
def test_ray_distance_equals_mju_ray_geom(kind: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    size = random_size(kind, rng)
    points, directions = _random_rays(rng, 256)
    expected = _mju_ray_geom(kind, size, points, directions)
    distances = np.asarray(_RAYS[kind](_vector(size), _vector(points), _vector(directions)))
    grown = _mju_ray_geom(kind, size * (1.0 + GRAZE), points, directions)
    shrunk = _mju_ray_geom(kind, size * (1.0 - GRAZE), points, directions)
    is_hit = np.isfinite(grown) & np.isfinite(shrunk)
    change = np.abs(np.where(is_hit, grown, 0.0) - np.where(is_hit, shrunk, 0.0))
    is_clear = (np.isinf(grown) == np.isinf(shrunk)) & (change < 30.0 * GRAZE)
    assert is_clear.mean() > 0.6
    assert not np.isnan(distances).any()
    np.testing.assert_allclose(distances[is_clear], expected[is_clear], rtol=RAY_TOLERANCE, atol=RAY_TOLERANCE)


@pytest.mark.parametrize("kind", sorted(CHORD_FUNCTIONS), ids=lambda kind: mjtGeom(kind).name)
@given(seed=SEEDS)
@settings(max_examples=12)
def test_chord_exists_where_the_line_intersects_the_solid(kind: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    size = random_size(kind, rng)
    points, directions = _random_rays(rng, 256)
    chord = np.asarray(_CHORDS[kind](_vector(size), _vector(points), _vector(directions)))
    far = points - 20.0 * directions

    def is_hit(scale: float) -> np.ndarray:
        hit = np.isfinite(_mju_ray_geom(kind, size * scale, far, directions))
        # mju_rayGeom hits a plane from its front only. Rotated by pi about x, the ray comes from the other side.
        flip = np.array([1.0, -1.0, -1.0])
        return hit | np.isfinite(_mju_ray_geom(kind, size * scale, far * flip, directions * flip))

    is_clear = is_hit(1.0 + GRAZE) == is_hit(1.0 - GRAZE)
    assert np.array_equal(np.isfinite(chord)[is_clear], is_hit(1.0)[is_clear])
    chosen = np.isfinite(chord) & is_clear
    inside = points[chosen] + chord[chosen, None] * directions[chosen]
    if kind != mjtGeom.mjGEOM_PLANE and len(inside):
        outward = inside / np.maximum(np.linalg.norm(inside, axis=1, keepdims=True), 1e-9) + 1e-3
        # From a point inside, rays in opposite directions both hit the wall.
        assert np.isfinite(_mju_ray_geom(kind, size * (1.0 + GRAZE), inside, outward)).all()
        assert np.isfinite(_mju_ray_geom(kind, size * (1.0 + GRAZE), inside, -outward)).all()
