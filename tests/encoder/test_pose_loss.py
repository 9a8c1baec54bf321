"""The pose loss: wanted cosines, angles between views of symmetric objects, and the measures of matches."""

import dataclasses
import math

import hypothesis
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from vsearch_jax import encoder as encoders
from vsearch_jax.config import Config, ConfigError, EncoderConfig
from vsearch_jax.encoder import pose_loss

CONFIG = Config()


def random_rotations(count: int, seed: int) -> np.ndarray:
    return Rotation.random(count, random_state=seed).as_matrix().astype(np.float32)


@hypothesis.given(st.floats(0.5, 20.0), st.floats(0.0, 0.8))
def test_the_threshold_angle_has_the_threshold_as_cosine(angle_deg, wide):
    hypothesis.assume(1.0 - wide + wide * math.cos(math.radians(angle_deg)) > CONFIG.env.threshold)
    encoder = dataclasses.replace(CONFIG.encoder, threshold_angle_deg=angle_deg, wide_weight=wide)
    config = dataclasses.replace(CONFIG, encoder=encoder)
    angles = jnp.radians(jnp.asarray([0.0, 0.5 * angle_deg, angle_deg, 2.0 * angle_deg]))
    cosines = np.asarray(pose_loss.wanted_cosine(angles, config))
    assert cosines[0] == pytest.approx(1.0, abs=1e-6)
    assert cosines[2] == pytest.approx(CONFIG.env.threshold, abs=1e-5)
    assert (np.diff(cosines) < 0.0).all()


def test_the_wide_part_leads_back_from_the_far_side():
    angles = jnp.radians(jnp.asarray([90.0, 120.0, 150.0, 180.0]))
    assert (np.diff(np.asarray(pose_loss.wanted_cosine(angles, CONFIG))) < -0.02).all()


def test_angles_between_views_equal_scipys():
    rotations = random_rotations(6, 1)
    expected = [
        [(Rotation.from_matrix(a).inv() * Rotation.from_matrix(b)).magnitude() for b in rotations] for a in rotations
    ]
    np.testing.assert_allclose(encoders.view_angles(jnp.asarray(rotations), 1), expected, atol=1e-3)


@pytest.mark.parametrize("order", [2, 3, 7, 0])
def test_angles_of_a_symmetric_object_are_the_smallest_over_its_turns(order):
    rotations = random_rotations(5, 2)
    turns = Rotation.from_euler("z", np.linspace(0.0, 2.0 * math.pi, order or 7200, endpoint=False)[:, None])
    expected = np.zeros((5, 5))
    for i, a in enumerate(rotations):
        for j, b in enumerate(rotations):
            expected[i, j] = (Rotation.from_matrix(a).inv() * turns * Rotation.from_matrix(b)).magnitude().min()
    np.testing.assert_allclose(encoders.view_angles(jnp.asarray(rotations), order), expected, atol=2e-3)


def test_codes_with_the_wanted_cosines_have_no_loss():
    """The wanted cosines of views on a circle are a positive definite matrix. Its root gives such codes."""
    turns = Rotation.from_euler("z", np.linspace(0.0, 2.0 * math.pi, 40, endpoint=False)[:, None]).as_matrix()
    angles = encoders.view_angles(jnp.asarray(turns, jnp.float32), 1)
    wanted = np.asarray(pose_loss.wanted_cosine(angles, CONFIG), np.float64)
    values, vectors = np.linalg.eigh(wanted)
    assert values.min() > -1e-5
    codes = jnp.asarray(vectors * np.sqrt(np.maximum(values, 0.0)), jnp.float32)
    assert float(pose_loss.pose_loss(3.0 * codes, angles, CONFIG)) < 1e-8
    other = jax.random.normal(jax.random.key(0), codes.shape)
    assert float(pose_loss.pose_loss(other, angles, CONFIG)) > 0.1


def test_a_hidden_mark_costs_a_near_pair_no_more_than_linearly_and_a_far_pair_the_square():
    """Two codes in a plane; the distance of unit codes a turn t apart is 2 sin(t / 2)."""

    def loss(turn: float, angle_deg: float) -> float:
        codes = jnp.asarray([[1.0, 0.0], [math.cos(turn), math.sin(turn)]])
        angles = jnp.radians(jnp.asarray([[0.0, angle_deg], [angle_deg, 0.0]]))
        return float(pose_loss.pose_loss(codes, angles, CONFIG))

    near = [loss(2.0 * math.asin(0.5 * distance), 0.0) for distance in (0.0, 0.5, 1.0, 1.5)]
    assert near[3] - near[2] == pytest.approx(near[2] - near[1], rel=0.03)
    assert near[1] - near[0] < near[2] - near[1]
    wanted = float(pose_loss.wanted_cosine(jnp.radians(90.0), CONFIG))
    assert loss(0.0, 90.0) == pytest.approx((1.0 - wanted) ** 2, rel=1e-4)


def test_matches_are_counted_as_by_loops():
    codes = np.random.default_rng(0).normal(size=(30, 3)).astype(np.float32)
    turns = Rotation.from_rotvec(np.random.default_rng(1).normal(scale=0.5, size=(30, 3))).as_matrix()
    angles = np.asarray(encoders.view_angles(jnp.asarray(turns, jnp.float32), 1))
    config = dataclasses.replace(CONFIG, env=dataclasses.replace(CONFIG.env, threshold=0.9))
    found = []
    for i in range(30):
        for j in range(30):
            cosine = codes[i] @ codes[j] / np.linalg.norm(codes[i]) / np.linalg.norm(codes[j])
            if i != j and cosine >= 0.9:
                found.append(math.degrees(angles[i, j]))
    measured = encoders.match_metrics(jnp.asarray(codes), jnp.asarray(angles), config, 60.0)
    is_false = np.asarray(found) > 60.0
    assert 0.0 < is_false.mean() < 1.0
    assert float(measured["false_match_rate"]) == pytest.approx(is_false.mean(), abs=1e-6)


def test_the_measured_threshold_angle_is_where_the_cosine_meets_the_threshold():
    views_deg = np.random.default_rng(0).uniform(0.0, 40.0, 60)
    angles = np.deg2rad(np.abs(views_deg[:, None] - views_deg[None]))
    turns = np.deg2rad(3.0 * views_deg)  # of the codes: they turn by three degrees for each degree of the view
    codes = np.stack([np.cos(turns), np.sin(turns)], axis=-1)
    measured = encoders.match_metrics(jnp.asarray(codes, jnp.float32), jnp.asarray(angles, jnp.float32), CONFIG, 4.0)
    wanted = math.degrees(math.acos(CONFIG.env.threshold)) / 3.0
    assert float(measured["threshold_angle_deg"]) == pytest.approx(wanted, rel=0.02)


def test_without_a_match_the_measures_are_nan():
    measured = encoders.match_metrics(jnp.eye(4), jnp.ones((4, 4)), CONFIG, 10.0)
    assert all(math.isnan(float(value)) for value in measured.values())


def test_gradients_are_finite_where_codes_are_zero_or_equal():
    latents = jnp.zeros((4, 8)).at[2:].set(1.0)
    angles = jnp.zeros((4, 4))
    assert np.isfinite(jax.grad(pose_loss.pose_loss)(latents, angles, CONFIG)).all()


def test_only_the_losses_that_reconstruct_have_a_decoder():
    for loss, has_decoder in (("pose", False), ("autoencoder", True), ("both", True)):
        encoder = dataclasses.replace(CONFIG.encoder, loss=loss)
        state = jax.eval_shape(
            lambda key, e=encoder: encoders.init(key, dataclasses.replace(CONFIG, encoder=e)), jax.random.key(0)
        )
        assert ("decoder" in state.params) == has_decoder


def test_a_threshold_that_the_wanted_cosine_cannot_have_is_refused():
    encoder = dataclasses.replace(CONFIG.encoder, threshold_angle_deg=20.0, wide_weight=0.5)
    with pytest.raises(ConfigError, match=r"EnvConfig.threshold is 0\.98; allowed: between 0\.4698 and 0\.9698"):
        dataclasses.replace(CONFIG, encoder=encoder)


def test_whitening_is_refused_with_a_pose_loss():
    with pytest.raises(ConfigError, match=r"whitening_power is 0\.5; allowed: 0, because"):
        EncoderConfig(loss="pose", whitening_power=0.5)
