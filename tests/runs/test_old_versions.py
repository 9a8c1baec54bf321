import json
from pathlib import Path

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
import orbax.checkpoint as ocp
import pytest

from vsearch_jax import encoder, runs
from vsearch_jax.config import Config
from vsearch_jax.runs import checkpoint
from vsearch_jax.runs.checkpoint import CheckpointError
from vsearch_jax.runs.old_versions import current_names

CONFIG = Config.preset("smoke")
STEP = 7
RUN_OF_0_2_0 = Path(__file__).parents[1] / "samples" / "run_of_0_2_0.json"
"""Written by 0.2.0: config.json of its preset `cpu`, and names and shapes of the encoder in its checkpoints."""


@flax.struct.dataclass
class Run:
    """A stand-in for TrainState with the containers whose fields were renamed after version 0.1.0."""

    env: dict
    replay: dict
    key: jax.Array
    step: jax.Array


def make_run() -> Run:
    keys = jax.random.split(jax.random.key(5), 4)
    observation = {"qpos": jax.random.normal(keys[0], (3, 9)), "code": jnp.ones((3, 4))}
    transitions = {
        "obs": jax.random.normal(keys[1], (2, 5)),
        "next_obs": jax.random.normal(keys[2], (2, 5)),
        "terminated": jnp.zeros(2),
    }
    return Run(
        env={"pipeline_state": {"observation": observation, "target": observation}, "obs": jnp.arange(6.0)},
        replay={"data": transitions},
        key=keys[3],
        step=jnp.int32(STEP),
    )


def old_name(name: str) -> str:
    """Returns the name that version 0.1.0 gave to an array."""
    renamed = name.replace(".observation.", ".sight.").replace("replay.data.next_obs", "replay.data.next_observation")
    return "replay.data.observation" if renamed == "replay.data.obs" else renamed


def save_as_version_0_1_0(folder: Path, run: Run) -> None:
    """Writes a checkpoint with orbax as version 0.1.0 did: old names, an array more, and no version."""
    leaves = {
        jax.tree_util.keystr(path, simple=True, separator="."): leaf
        for path, leaf in jax.tree_util.tree_leaves_with_path(run)
    }
    arrays = {old_name(name): np.asarray(leaf) for name, leaf in leaves.items() if name != "key"}
    arrays["key"] = np.asarray(jax.random.key_data(run.key))
    arrays["replay.data.truncated"] = np.zeros(2, np.float32)
    about = {
        "config": CONFIG.to_dict(),
        "keys": {"key": str(jax.random.key_impl(run.key))},
        "arrays": {name: [list(array.shape), str(array.dtype)] for name, array in arrays.items()},
    }
    arguments = ocp.args.Composite(state=ocp.args.StandardSave(arrays), about=ocp.args.JsonSave(about))
    with ocp.CheckpointManager((folder / "checkpoints").absolute()) as manager:
        manager.save(STEP, args=arguments)


def test_a_checkpoint_of_version_0_1_0_is_read(tmp_path: Path) -> None:
    run = make_run()
    save_as_version_0_1_0(tmp_path, run)
    restored = checkpoint.restore(tmp_path, jax.eval_shape(make_run), CONFIG)
    assert jax.tree.structure(restored) == jax.tree.structure(run)
    assert jax.random.key_impl(restored.key) == jax.random.key_impl(run.key)
    for new, old in zip(jax.tree.leaves(restored), jax.tree.leaves(run), strict=True):
        if jnp.issubdtype(new.dtype, jax.dtypes.prng_key):
            new, old = jax.random.key_data(new), jax.random.key_data(old)
        assert new.dtype == old.dtype
        np.testing.assert_array_equal(np.asarray(new), np.asarray(old))


def test_a_restored_old_run_is_saved_with_the_present_names(tmp_path: Path) -> None:
    save_as_version_0_1_0(tmp_path, make_run())
    restored = checkpoint.restore(tmp_path, jax.eval_shape(make_run), CONFIG)
    checkpoint.save(tmp_path, restored.replace(step=jnp.int32(STEP + 1)), CONFIG)
    again = checkpoint.restore(tmp_path, jax.eval_shape(make_run), CONFIG)
    np.testing.assert_array_equal(again.replay["data"]["obs"], restored.replay["data"]["obs"])


def test_the_version_of_an_old_checkpoint_that_does_not_fit_is_named(tmp_path: Path) -> None:
    save_as_version_0_1_0(tmp_path, make_run())
    template = jax.eval_shape(make_run).replace(key=jax.ShapeDtypeStruct((3,), jnp.float32))
    with pytest.raises(CheckpointError, match=r"written by vsearch_jax 0\.1\.0, .* use vsearch_jax 0\.1\.0") as error:
        checkpoint.restore(tmp_path, template, CONFIG)
    assert "key is uint32[2] in the checkpoint and float32[3] now" in str(error.value)


def test_names_of_a_version_without_renames_stay() -> None:
    names = ["env.pipeline_state.sight.qpos", "replay.data.truncated"]
    assert current_names(names, "0.2.0") == {name: name for name in names}


def test_the_encoder_of_a_run_of_version_0_2_0_has_the_arrays_that_this_version_stored(tmp_path: Path) -> None:
    stored = json.loads(RUN_OF_0_2_0.read_text())
    (tmp_path / "config.json").write_text(json.dumps(stored["config"]))
    config = runs.read_config(tmp_path)
    state = jax.eval_shape(lambda: encoder.init(jax.random.key(0), config))
    leaves = jax.tree_util.tree_leaves_with_path(state)
    arrays = {jax.tree_util.keystr(path, simple=True, separator="."): list(leaf.shape) for path, leaf in leaves}
    assert arrays == stored["encoder"]


def test_a_run_of_version_0_2_0_keeps_its_mesh_as_it_lay(tmp_path: Path) -> None:
    (tmp_path / "config.json").write_text(json.dumps(json.loads(RUN_OF_0_2_0.read_text())["config"]))
    assert runs.read_config(tmp_path).scene.mesh_up == "z"
