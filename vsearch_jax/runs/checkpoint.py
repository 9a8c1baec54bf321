"""Checkpoints of a run, written by orbax.

Orbax writes to a temporary folder and then renames it. So a killed save leaves the last checkpoint intact.
Arrays are stored flat, each under its path in the pytree. So the files do not depend on how orbax treats the containers
of nnx, optax and brax. A typed PRNG key is stored as its data. The name of its implementation is stored apart.
"""

from __future__ import annotations

import importlib.metadata
import json
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import NotRequired, Protocol, TypeAlias, TypedDict, TypeVar, cast

import jax
import jax.numpy as jnp
import numpy as np

from vsearch_jax.config import Config
from vsearch_jax.runs import orbax_store
from vsearch_jax.runs.folder import CHECKPOINTS
from vsearch_jax.runs.old_versions import UNVERSIONED, current_names, with_later_fields
from vsearch_jax.runs.orbax_store import CheckpointError

_ABSENT = "absent"
_UNTRAINED_SECTIONS = ("random_search", "cma_es", "evaluation", "num_chunks")
"""Parts of the config that do not change the trained state."""


class _HasStep(Protocol):
    """A pytree with the number of iterations done, i32[]."""

    @property
    def step(self) -> jax.Array: ...


State = TypeVar("State")
Described: TypeAlias = tuple[list[int], str]
"""Shape and dtype of an array. JSON stores the tuple as a list."""


class _About(TypedDict):
    """Description of a checkpoint, stored as JSON beside the arrays.

    Attributes:
      version: version of vsearch_jax that wrote the checkpoint; missing in checkpoints of version 0.1.0.
      orbax: version of orbax-checkpoint; missing in checkpoints of versions before 0.3.0.
      config: `Config.to_dict` of the run.
      keys: for each typed PRNG key the name of its implementation.
      arrays: for each array its shape and dtype.
      checksums: for each array the CRC-32 of its bytes; missing in checkpoints of versions before 0.3.0.
    """

    version: NotRequired[str]
    orbax: NotRequired[str]
    config: dict[str, object]
    keys: dict[str, str]
    arrays: dict[str, Described]
    checksums: NotRequired[dict[str, int]]


def save(run: Path, state: _HasStep, config: Config) -> None:
    """Saves the state of a run as a checkpoint, and returns when the checkpoint is on disk.

    Args:
      run: folder of the run. The checkpoint goes to `run/checkpoints/<step>`.
      state: pytree of arrays. The attribute `step`, i32[], is the number of iterations done.
      config: the run's config, stored beside the arrays.

    Raises:
      CheckpointError: the folder holds a checkpoint of this step or of a later one, or orbax cannot write it.
      OSError: the disk is full or not writable.
    """
    leaves = _named_leaves(state)
    stored = {name: np.asarray(_data(leaf)) for name, leaf in leaves.items()}
    about: _About = {
        "version": _own_version(),
        "orbax": orbax_store.orbax_version(),
        "config": config.to_dict(),
        "keys": {name: str(jax.random.key_impl(leaf)) for name, leaf in leaves.items() if _is_key(leaf)},
        "arrays": {name: _shape_and_dtype(array) for name, array in stored.items()},
        "checksums": {name: _checksum(array) for name, array in stored.items()},
    }
    is_saved = orbax_store.write(run, int(state.step), _nonempty(stored), about)
    if not is_saved:  # Orbax does not save a step that is not after the last one.
        raise CheckpointError(f"{run / CHECKPOINTS} holds step {latest_step(run)} already; train into another folder")


def latest_step(run: Path) -> int | None:
    """Returns the step (iterations done) of the last complete checkpoint in a run's folder, None if there is none."""
    return max(orbax_store.steps(run), default=None)


def restore(run: Path, template: State, config: Config) -> State:
    """Loads the state that the last checkpoint of a run holds.

    Args:
      run: folder of the run.
      template: pytree of arrays or `jax.ShapeDtypeStruct` with the structure of the saved state, for example
        `jax.eval_shape` of `init`.
      config: config with which the run continues. Fields that only the evaluation reads may differ.

    Returns:
      The saved state. Checkpoints of version 0.1.0 are converted.

    Raises:
      CheckpointError: the checkpoint is missing, damaged, unreadable, or belongs to another config or version.
      OSError: the system cannot read a file of the checkpoint.
    """
    step = latest_step(run)
    if step is None:
        raise CheckpointError(f"no checkpoint in {run / CHECKPOINTS}; start a new run in another folder")
    folder = run / CHECKPOINTS / str(step)
    about = cast(_About, orbax_store.read_about(run, step))  # JSON has no static type
    version = about.get("version", UNVERSIONED)
    _check_config(folder, with_later_fields(about["config"]), config, version)
    described = {name: (shape, dtype) for name, (shape, dtype) in about["arrays"].items()}
    names = current_names(described, version)
    leaves = {name: jax.eval_shape(_data, leaf) for name, leaf in _named_leaves(template).items()}
    expected = {name: _shape_and_dtype(leaf) for name, leaf in leaves.items()}
    _check_arrays(folder, {names[stored]: described[stored] for stored in names}, expected, version)
    empty = {name: np.empty(shape, jnp.dtype(dtype)) for name, (shape, dtype) in described.items()}
    arrays = empty | orbax_store.read_arrays(run, step, _nonempty(empty))
    # Orbax notices damage to its index, not to the values.
    changed = [name for name, sum_ in about.get("checksums", {}).items() if _checksum(arrays[name]) != sum_]
    if changed:
        raise orbax_store.damaged(run, step, f"the values of {changed[0]} differ from those that were saved")
    current = {names[stored]: array for stored, array in arrays.items() if stored in names}
    keys = {names[stored]: implementation for stored, implementation in about["keys"].items()}
    restored = [_to_leaf(current[name], keys.get(name)) for name in expected]
    return jax.tree.unflatten(jax.tree.structure(template), restored)


def _first_difference(saved: Mapping[str, object], config: Config) -> str | None:
    """Returns the first field that differs and that changes the trained state, as text; None if all fields agree."""
    now, before = _flatten(_as_json(config.to_dict())), _flatten(saved)
    for name in [*now, *before]:
        is_trained = name.split(".")[0] not in _UNTRAINED_SECTIONS
        if is_trained and now.get(name, _ABSENT) != before.get(name, _ABSENT):
            return f"{name} is {before.get(name, _ABSENT)} in the checkpoint and {now.get(name, _ABSENT)} now"
    return None


def _check_config(folder: Path, saved: Mapping[str, object], config: Config, version: str) -> None:
    difference = _first_difference(saved, config)
    if difference is not None:
        raise CheckpointError(
            f"checkpoint {folder}, written by vsearch_jax {version}, belongs to another config: {difference}; use the "
            "config of the checkpoint, or another folder"
        )


def _check_arrays(
    folder: Path, found: Mapping[str, Described], expected: Mapping[str, Described], version: str
) -> None:
    own = _own_version()
    # In the same version, only another arm or object makes another shape.
    remedy = f"use vsearch_jax {version} to read it"
    if version == own:
        remedy = "restore the files of arm and object as they were when the run was trained"
    for name in [*expected, *found]:
        if found.get(name) != expected.get(name):
            raise CheckpointError(
                f"checkpoint {folder}, written by vsearch_jax {version}, does not fit vsearch_jax {own}: "
                f"{name} is {_text(found.get(name))} in the checkpoint and {_text(expected.get(name))} now; {remedy}"
            )


def _text(described: Described | None) -> str:
    return _ABSENT if described is None else f"{described[1]}{described[0]}"


def _own_version() -> str:
    return importlib.metadata.version("vsearch_jax")


def _checksum(array: np.ndarray) -> int:
    return zlib.crc32(np.ascontiguousarray(array).view(np.uint8).data) if array.size else 0


def _named_leaves(tree: object) -> dict[str, jax.Array]:
    """Returns the leaves of a pytree by their path. They may be `jax.ShapeDtypeStruct` in place of arrays."""
    leaves = jax.tree_util.tree_leaves_with_path(tree)
    return {jax.tree_util.keystr(path, simple=True, separator="."): leaf for path, leaf in leaves}


def _nonempty(arrays: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Removes arrays without entries, which orbax refuses. The template holds their shape and dtype."""
    return {name: array for name, array in arrays.items() if array.size > 0}


def _is_key(leaf: jax.Array) -> bool:
    return jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def _data(leaf: jax.Array) -> jax.Array:
    return jax.random.key_data(leaf) if _is_key(leaf) else leaf


def _to_leaf(stored: np.ndarray, key_impl: str | None) -> jax.Array:
    array = jnp.array(stored)
    return array if key_impl is None else jax.random.wrap_key_data(array, impl=key_impl)


def _shape_and_dtype(array: np.ndarray | jax.Array) -> Described:
    return list(array.shape), str(array.dtype)


def _as_json(values: Mapping[str, object]) -> dict[str, object]:
    return json.loads(json.dumps(values))


def _flatten(values: Mapping[str, object], prefix: str = "") -> dict[str, object]:
    """Returns nested dictionaries as one, with dotted names."""
    flat: dict[str, object] = {}
    for name, value in values.items():
        flat |= _flatten(value, f"{prefix}{name}.") if isinstance(value, dict) else {prefix + name: value}
    return flat
