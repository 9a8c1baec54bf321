"""Training as one function: one trace for each config, equality of chunks, dependence on the seed, finite values."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import vsearch_jax as vs
from vsearch_jax import encoder as encoders
from vsearch_jax.runs import checkpoint
from vsearch_jax.runs.old_versions import current_names
from vsearch_jax.training import encoder_iteration, with_encoder
from vsearch_jax.training import run as training

# Silhouettes need no light, which takes half of the renderer's compile time.
SMOKE = vs.Config.preset("smoke")
CONFIG = dataclasses.replace(SMOKE, encoder=dataclasses.replace(SMOKE.encoder, input="silhouette"))
ARRAYS_OF_0_1_0 = Path(__file__).parent / "samples" / "arrays_of_0_1_0.json"
"""Shape and dtype of each array in a checkpoint that version 0.1.0 wrote for the preset smoke."""


def arrays(state):
    """Returns the leaves of a state by path. A PRNG key is returned as its data."""

    def as_numpy(x):
        return np.asarray(jax.random.key_data(x) if jnp.issubdtype(x.dtype, jax.dtypes.prng_key) else x)

    leaves = jax.tree_util.tree_flatten_with_path(state)[0]
    return {jax.tree_util.keystr(path): as_numpy(leaf) for path, leaf in leaves}


def run(config, seed=0):
    """Returns state and metrics after all chunks of a run."""
    # The state before training does not depend on the number of chunks, so one compiled `init` serves all.
    state, rows = vs.init(jax.random.key(seed), dataclasses.replace(config, num_chunks=CONFIG.num_chunks)), []
    for _ in range(config.num_chunks):
        state, metrics = vs.train(state, config)
        rows.append(jax.tree.map(np.asarray, metrics))
    return state, {name: np.concatenate([row[name] for row in rows]) for name in rows[0]}


@pytest.fixture(scope="module")
def chunked():
    """State and metrics of a run in chunks, and the number of traces."""
    training._train.clear_cache()
    state, metrics = run(CONFIG)
    return state, metrics, training._train._cache_size()


def test_all_chunks_of_a_config_share_one_trace(chunked):
    assert chunked[2] == 1


def test_run_in_one_piece_equals_a_run_in_chunks_bit_for_bit(chunked):
    state, metrics = run(dataclasses.replace(CONFIG, num_chunks=1))
    for path, expected in arrays(chunked[0]).items():
        np.testing.assert_array_equal(arrays(state)[path], expected, err_msg=path)
    count = CONFIG.num_iterations
    for name, expected in chunked[1].items():
        np.testing.assert_array_equal(metrics[name][:count], expected[:count], err_msg=name)


def test_metrics_are_finite_in_their_stage_and_nan_in_the_other(chunked):
    metrics = chunked[1]
    stage, updates = metrics["stage"], CONFIG.encoder.num_updates
    assert stage.tolist()[: CONFIG.num_iterations] == [0] * updates + [1] * CONFIG.num_policy_iterations
    assert np.isfinite(metrics["encoder_loss"][:updates]).all()
    assert np.isnan(metrics["encoder_loss"][updates:]).all()
    assert np.isfinite(metrics["reward"][stage == 1]).all()
    assert np.isnan(metrics["reward"][stage == 0]).all()
    is_learning = np.arange(CONFIG.num_policy_iterations) * CONFIG.sac.num_envs >= CONFIG.sac.num_warmup_steps
    np.testing.assert_array_equal(np.isfinite(metrics["critic_loss"][stage == 1]), is_learning)


def test_encoder_changes_in_its_stage_and_stays_in_the_policy_stage():
    start = vs.init(jax.random.key(0), CONFIG)
    untrained = {path: leaf.copy() for path, leaf in arrays(start.encoder).items()}
    config, num_policy_chunks = dataclasses.replace(CONFIG, num_chunks=4), 0
    state, _ = vs.train(start, config)
    assert any((leaf != untrained[path]).any() for path, leaf in arrays(state.encoder).items() if "params" in path)
    for _ in range(3):
        before = arrays(state.encoder)
        state, metrics = vs.train(state, config)
        if (np.asarray(metrics["stage"]) == 1).all():
            num_policy_chunks += 1
            after = arrays(state.encoder)
            assert all((before[path] == after[path]).all() for path in before)
    assert num_policy_chunks > 0


def test_the_encoder_learns_to_tell_views_apart_that_it_was_not_trained_on():
    encoder = dataclasses.replace(CONFIG.encoder, num_updates=200, batch_size=32)
    config = dataclasses.replace(CONFIG, encoder=encoder)
    untrained = encoders.init(jax.random.key(0), config)
    env = vs.ViewSearchEnv(config, untrained)

    def update(i, encoder):
        return encoder_iteration(i, encoder, env=env, key=jax.random.key(1))[0]

    @jax.jit
    def observe(key):
        view, qpos = env.random_view(key)
        return env.wrist_image(env.resolve_view(view, qpos, jnp.bool_(False))[1])

    @jax.jit
    def encode(encoder, image):
        return encoders.encode(encoder, encoders.network_input(image, env.scene.object_geom_ids, config), config)

    trained = jax.jit(lambda start: jax.lax.fori_loop(0, encoder.num_updates, update, start))(untrained)
    cameras, images = zip(*(observe(key) for key in jax.random.split(jax.random.key(2), 100)), strict=True)
    turns = Rotation.from_matrix(np.array([camera.rotation for camera in cameras]))
    angles = np.rad2deg([(turns[i].inv() * turns).magnitude() for i in range(100)])
    is_far, is_near = angles > 15.0, (angles > 0.0) & (angles < 3.0)
    best_wrong = []
    for state in (untrained, trained):
        codes = np.array([encode(state, image) for image in images])
        codes /= np.linalg.norm(codes, axis=1, keepdims=True)
        cosines = codes @ codes.T
        best_wrong.append(np.median(np.where(is_far, cosines, -1.0).max(axis=1)))
    assert best_wrong[0] > 0.85
    assert best_wrong[1] < 0.8
    assert cosines[is_near].mean() > 0.97  # the wanted cosine is 0.98 or more up to 3 degrees


def test_policies_start_with_the_encoder_of_another_run_and_a_fixed_target(chunked):
    other = chunked[0].encoder
    config = dataclasses.replace(CONFIG, env=dataclasses.replace(CONFIG.env, target="fixed"))
    state = with_encoder(vs.init(jax.random.key(1), config), other, config)
    assert int(state.step) == config.encoder.num_updates
    for path, leaf in arrays(other).items():
        np.testing.assert_array_equal(arrays(state.encoder)[path], leaf, err_msg=path)
    view = state.env.pipeline_state.target.view
    wanted = np.deg2rad([config.evaluation.target_azimuth_deg, config.evaluation.target_elevation_deg])
    for angles, angle in ((view.azimuth, wanted[0]), (view.elevation, wanted[1])):
        np.testing.assert_allclose(angles, np.full((1, config.sac.num_envs), angle), atol=1e-5)
    azimuths = np.asarray(state.env.pipeline_state.observation.view.azimuth)
    assert np.unique(azimuths).size > 1  # the initial views stay random


def test_state_is_finite_after_the_run(chunked):
    for path, leaf in arrays(chunked[0]).items():
        assert np.isfinite(leaf).all(), path


def test_replay_counts_every_environment_step(chunked):
    replay = chunked[0].replay
    assert np.asarray(replay.num_inserted).tolist() == [CONFIG.sac.num_environment_steps] * CONFIG.sac.num_seeds
    assert int(chunked[0].step) == CONFIG.num_iterations


def test_train_after_the_last_chunk_changes_nothing(chunked):
    before = arrays(chunked[0])
    copy = jax.tree.map(lambda x: x.copy(), chunked[0])  # `train` donates its argument.
    state, metrics = vs.train(copy, CONFIG)
    assert (np.asarray(metrics["stage"]) == -1).all()
    for path, leaf in arrays(state).items():
        np.testing.assert_array_equal(leaf, before[path], err_msg=path)


def test_restored_run_equals_an_uninterrupted_run_bit_for_bit(chunked, tmp_path):
    state = vs.init(jax.random.key(0), CONFIG)
    for _ in range(2):
        state, _ = vs.train(state, CONFIG)
    checkpoint.save(tmp_path, state, CONFIG)
    template = jax.eval_shape(lambda key: vs.init(key, CONFIG), jax.random.key(0))
    restored = checkpoint.restore(tmp_path, template, CONFIG)
    for _ in range(2):
        restored, _ = vs.train(restored, CONFIG)
    for path, expected in arrays(chunked[0]).items():
        np.testing.assert_array_equal(arrays(restored)[path], expected, err_msg=path)


def test_the_arrays_of_version_0_1_0_are_those_of_this_version():
    def describe(leaf):
        is_key = jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)
        leaf = jax.eval_shape(jax.random.key_data, leaf) if is_key else leaf
        return [list(leaf.shape), str(leaf.dtype)]

    stored = json.loads(ARRAYS_OF_0_1_0.read_text())
    names = current_names(stored, "0.1.0")
    assert len(set(names.values())) == len(names)
    # Version 0.1.0 had the autoencoder, by Adam, without a hidden layer, and a policy without shared layers.
    encoder = dataclasses.replace(SMOKE.encoder, loss="autoencoder", optimizer="adam", hidden_sizes=())
    policy = dataclasses.replace(SMOKE.sac, network="plain")
    config = dataclasses.replace(SMOKE, encoder=encoder, sac=policy)
    state = jax.eval_shape(lambda key: vs.init(key, config), jax.random.key(0))
    assert {current: stored[old] for old, current in names.items()} == {
        jax.tree_util.keystr(path, simple=True, separator="."): describe(leaf)
        for path, leaf in jax.tree_util.tree_leaves_with_path(state)
    }


def test_initial_parameters_depend_on_the_seed():
    other = vs.init(jax.random.key(1), CONFIG)
    first = vs.init(jax.random.key(0), CONFIG)
    a, b = arrays(first.encoder.params), arrays(other.encoder.params)
    assert any((a[path] != b[path]).any() for path in a)
    a, b = arrays(first.sac.actor), arrays(other.sac.actor)
    assert any((a[path] != b[path]).any() for path in a)
