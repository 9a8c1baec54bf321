import dataclasses
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any, NamedTuple

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from brax.envs.base import State
from flax import nnx

from vsearch_jax.config import Config
from vsearch_jax.runs import checkpoint
from vsearch_jax.runs.checkpoint import CheckpointError

CONFIG = Config.preset("smoke")


class Pair(NamedTuple):
    left: jax.Array
    right: jax.Array


@flax.struct.dataclass
class Run:
    """A stand-in for TrainState with each kind of container and leaf that TrainState holds."""

    params: Any
    opt_state: Any
    env: State
    pair: Pair
    keys: jax.Array
    step: jax.Array


def make_run(key: jax.Array, step: int = 0) -> Run:
    _, params, _ = nnx.split(nnx.Linear(3, 2, rngs=nnx.Rngs(0)), nnx.Param, ...)
    params = jax.tree.map(lambda x: jax.random.normal(key, x.shape, x.dtype), params)
    return Run(
        params=params,
        opt_state=optax.adam(1e-3).init(params),
        env=State(None, jnp.zeros((2, 4)), jnp.zeros(2), jnp.zeros(2), {"a": jnp.ones(2)}, {"truncated": jnp.zeros(2)}),
        pair=Pair(jnp.zeros((0, 3)), jnp.arange(3, dtype=jnp.bfloat16)),
        keys=jax.random.split(key, 3),
        step=jnp.asarray(step, jnp.int32),
    )


def assert_same(a: Any, b: Any) -> None:
    assert jax.tree.structure(a) == jax.tree.structure(b)
    for left, right in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        assert left.dtype == right.dtype
        if jnp.issubdtype(left.dtype, jax.dtypes.prng_key):
            left, right = jax.random.key_data(left), jax.random.key_data(right)
        np.testing.assert_array_equal(np.asarray(left), np.asarray(right))


@pytest.fixture
def template() -> Any:
    return jax.eval_shape(make_run, jax.random.key(0))


def largest_file(folder: Path) -> Path:
    return max((path for path in folder.rglob("*") if path.is_file()), key=lambda path: path.stat().st_size)


def test_restores_every_leaf_bit_for_bit_and_keeps_two(tmp_path: Path, template: Any) -> None:
    for step in (0, 4, 8):
        state = make_run(jax.random.key(step), step)
        checkpoint.save(tmp_path, state, CONFIG)
    assert_same(checkpoint.restore(tmp_path, template, CONFIG), state)
    assert sorted(path.name for path in (tmp_path / "checkpoints").iterdir()) == ["4", "8"]
    assert checkpoint.latest_step(tmp_path) == 8


@pytest.mark.parametrize("impl", ["rbg", "unsafe_rbg"])
def test_restored_keys_keep_their_implementation(tmp_path: Path, impl: str) -> None:
    state = make_run(jax.random.key(1, impl=impl), 1)
    checkpoint.save(tmp_path, state, CONFIG)
    restored = checkpoint.restore(tmp_path, jax.eval_shape(lambda: state), CONFIG)
    assert jax.random.key_impl(restored.keys) == impl
    assert_same(restored, state)


def test_missing_checkpoint_is_named(tmp_path: Path, template: Any) -> None:
    with pytest.raises(CheckpointError, match=f"no checkpoint in {tmp_path}"):
        checkpoint.restore(tmp_path, template, CONFIG)


def test_first_differing_field_of_another_config_is_named(tmp_path: Path, template: Any) -> None:
    checkpoint.save(tmp_path, make_run(jax.random.key(0)), CONFIG)
    other = dataclasses.replace(CONFIG, encoder=dataclasses.replace(CONFIG.encoder, channels=(8, 32)))
    with pytest.raises(CheckpointError, match=r"encoder\.channels is \[8, 16\] in the checkpoint and \[8, 32\] now"):
        checkpoint.restore(tmp_path, template, other)


def test_fields_that_only_the_evaluation_reads_may_differ(tmp_path: Path, template: Any) -> None:
    state = make_run(jax.random.key(0))
    checkpoint.save(tmp_path, state, CONFIG)
    other = dataclasses.replace(CONFIG, evaluation=dataclasses.replace(CONFIG.evaluation, num_runs=7))
    assert_same(checkpoint.restore(tmp_path, template, other), state)


def test_state_of_another_shape_is_named(tmp_path: Path) -> None:
    checkpoint.save(tmp_path, make_run(jax.random.key(0)), CONFIG)
    with pytest.raises(CheckpointError, match=r"step is int32\[\] in the checkpoint and float32\[\] now"):
        checkpoint.restore(tmp_path, {"step": jnp.zeros(())}, CONFIG)


def test_the_version_of_a_checkpoint_that_does_not_fit_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, template: Any
) -> None:
    with monkeypatch.context() as context:
        context.setattr(checkpoint, "_own_version", lambda: "9.8.7")
        checkpoint.save(tmp_path, make_run(jax.random.key(0)), CONFIG)
    with pytest.raises(
        CheckpointError, match=r"written by vsearch_jax 9\.8\.7, does not fit .* use vsearch_jax 9\.8\.7"
    ):
        checkpoint.restore(tmp_path, {"step": jnp.zeros(())}, CONFIG)
    other = dataclasses.replace(CONFIG, encoder=dataclasses.replace(CONFIG.encoder, channels=(8, 32)))
    with pytest.raises(CheckpointError, match=r"written by vsearch_jax 9\.8\.7, belongs to another config"):
        checkpoint.restore(tmp_path, template, other)


def test_every_file_cut_in_half_is_an_error_of_one_line(tmp_path: Path, template: Any) -> None:
    state = make_run(jax.random.key(0), 3)
    checkpoint.save(tmp_path, state, CONFIG)
    folder = tmp_path / "checkpoints" / "3"
    num_damaging = 0
    for path in sorted(p for p in folder.rglob("*") if p.is_file() and p.stat().st_size > 1):
        whole = path.read_bytes()
        path.write_bytes(whole[: len(whole) // 2])
        try:
            # Some files are not read. If one of them is cut, the restored state must be right.
            assert_same(checkpoint.restore(tmp_path, template, CONFIG), state)
        except CheckpointError as error:
            num_damaging += 1
            assert "\n" not in str(error) and str(folder) in str(error) and "damaged" in str(error)
            assert "there is no other checkpoint" in str(error) and "delete" not in str(error)
        path.write_bytes(whole)
    assert num_damaging >= 3
    assert_same(checkpoint.restore(tmp_path, template, CONFIG), state)


def test_a_changed_byte_is_an_error_or_changes_nothing(tmp_path: Path, template: Any) -> None:
    """Orbax notices damage to its index only. The values have checksums of ours."""
    state = make_run(jax.random.key(0), 3)
    checkpoint.save(tmp_path, state, CONFIG)
    path = largest_file(tmp_path / "checkpoints" / "3" / "state")
    whole, num_damaging = path.read_bytes(), 0
    for place in range(0, len(whole), max(1, len(whole) // 60)):
        path.write_bytes(whole[:place] + bytes([whole[place] ^ 0xFF]) + whole[place + 1 :])
        try:
            assert_same(checkpoint.restore(tmp_path, template, CONFIG), state)
        except CheckpointError as error:
            num_damaging += 1
            assert "damaged" in str(error)
    assert num_damaging > 0


def test_a_damaged_checkpoint_is_moved_aside_and_the_earlier_one_is_read(tmp_path: Path, template: Any) -> None:
    states = [make_run(jax.random.key(step), step) for step in (2, 4)]
    for state in states:
        checkpoint.save(tmp_path, state, CONFIG)
    damaged = tmp_path / "checkpoints" / "4"
    path = largest_file(damaged / "state")
    path.write_bytes(path.read_bytes()[:10])
    with pytest.raises(CheckpointError, match=r"move that folder out of .* resume from iteration 2: vsearch train"):
        checkpoint.restore(tmp_path, template, CONFIG)
    damaged.rename(tmp_path / "damaged-4")
    assert_same(checkpoint.restore(tmp_path, template, CONFIG), states[0])


def test_a_save_killed_at_any_moment_leaves_a_whole_checkpoint(tmp_path: Path, template: Any) -> None:
    code = (
        "import sys, jax; from pathlib import Path; sys.path.insert(0, sys.argv[2]);"
        "from test_checkpoint import make_run, CONFIG; from vsearch_jax.runs import checkpoint\n"
        "for step in range(10**6): checkpoint.save(Path(sys.argv[1]), make_run(jax.random.key(step), step), CONFIG)"
    )
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    process = subprocess.Popen([sys.executable, "-c", code, str(tmp_path), str(Path(__file__).parent)], env=environment)
    deadline = time.monotonic() + 300
    while (checkpoint.latest_step(tmp_path) or 0) < 3 and process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.013)
    process.send_signal(signal.SIGKILL)
    process.wait()
    step = checkpoint.latest_step(tmp_path)
    assert step is not None and step >= 3
    assert_same(checkpoint.restore(tmp_path, template, CONFIG), make_run(jax.random.key(step), step))
    checkpoint.save(tmp_path, make_run(jax.random.key(step), step + 1), CONFIG)
    assert checkpoint.latest_step(tmp_path) == step + 1
