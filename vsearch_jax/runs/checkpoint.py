"""Checkpoints of a whole run by orbax: written to a temporary folder and renamed, so a killed save leaves the last one.

Leaves are stored flat under the path of their pytree, so what is on disk does not depend on how orbax sees nnx, optax
or brax containers; typed PRNG keys are stored as their data beside the name of their implementation.
"""

from __future__ import annotations

import contextlib
import json
import logging
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import orbax.checkpoint as ocp
import tensorstore

from vsearch_jax.config import Config
from vsearch_jax.runs.folder import CHECKPOINTS

NUM_KEPT = 2
"""Checkpoints kept in a run's folder: the last one and the one before."""

_ABSENT = "absent"
_UNTRAINED = ("random_search", "cma_es", "evaluation", "num_chunks")
"""Parts of the config that a trained state does not depend on."""


class CheckpointError(ValueError):
    """A checkpoint is missing, damaged or of another config; the message says which and what to do."""


def save(run: Path, state: Any, config: Config) -> None:
    """Saves `state` as the checkpoint of its step; returns when it is on disk.

    Args:
      run: the run's folder; the checkpoint goes to `run/checkpoints/<step>`.
      state: a pytree of arrays with an attribute `step`, i32[].
      config: the run's config, kept beside the arrays.

    Raises:
      CheckpointError: the folder holds a checkpoint of this step or a later one.
      OSError: the disk is full or not writable.
    """
    leaves = _named_leaves(state)
    stored = {name: np.asarray(_data(leaf)) for name, leaf in leaves.items()}
    about = {
        "config": config.to_dict(),
        "keys": {name: str(jax.random.key_impl(leaf)) for name, leaf in leaves.items() if _is_key(leaf)},
        "arrays": {name: _describe(array) for name, array in stored.items()},
    }
    arguments = ocp.args.Composite(state=ocp.args.StandardSave(_not_empty(stored)), about=ocp.args.JsonSave(about))
    with _one_error(), _manager(run) as manager:
        try:
            is_saved = manager.save(int(state.step), args=arguments)
        except ValueError as error:  # tensorstore reports what the disk refused as a ValueError
            raise OSError(f"cannot write a checkpoint to {run / CHECKPOINTS}: {_first_line(error)}") from error
    if not is_saved:  # orbax leaves a step alone that is not past the last one
        raise CheckpointError(f"{run / CHECKPOINTS} holds step {latest_step(run)} already; train into another folder")


def latest_step(run: Path) -> int | None:
    """Returns the step of the last complete checkpoint in the folder `run`, None if there is none."""
    return max(_steps(run), default=None)


def _steps(run: Path) -> list[int]:
    return [int(path.name) for path in (run / CHECKPOINTS).glob("*") if path.name.isdecimal()]


def restore(run: Path, template: Any, config: Config) -> Any:
    """Returns the last checkpoint in the folder `run`.

    Args:
      run: the run's folder.
      template: a pytree of arrays or `jax.ShapeDtypeStruct` like the one saved, as `jax.eval_shape` of `init` gives.
      config: the config that the run is to go on with; what only evaluation reads may differ.

    Raises:
      CheckpointError: there is no checkpoint, it is damaged, or it belongs to another config.
    """
    step = latest_step(run)
    if step is None:
        raise CheckpointError(f"no checkpoint in {run / CHECKPOINTS}; train anew, into another folder")
    folder = run / CHECKPOINTS / str(step)
    about = _read(run, step, "about", ocp.args.JsonRestore())
    _check_config(folder, about["config"], config)
    expected = {name: jax.eval_shape(_data, leaf) for name, leaf in _named_leaves(template).items()}
    _check_arrays(folder, about["arrays"], {name: _describe(leaf) for name, leaf in expected.items()})
    # Restored to numpy first: orbax would place jax arrays on the devices of the machine that saved them.
    arrays = {name: np.empty(leaf.shape, leaf.dtype) for name, leaf in expected.items()}
    arrays |= _read(run, step, "state", ocp.args.StandardRestore(_not_empty(arrays)))
    leaves = [_leaf(arrays[name], about["keys"].get(name)) for name in expected]
    return jax.tree.unflatten(jax.tree.structure(template), leaves)


def first_difference(saved: dict[str, Any], config: Config) -> str | None:
    """Returns "field is X there and Y here" for the first trained field in which `saved` differs, None if all agree.

    Args:
      saved: `Config.to_dict` of the other config, as it was or as read from JSON.
      config: the config at hand.
    """
    here, there = _flatten(_as_json(config.to_dict())), _flatten(_as_json(saved))
    for name in [*here, *there]:
        is_trained = name.split(".")[0] not in _UNTRAINED
        if is_trained and here.get(name, _ABSENT) != there.get(name, _ABSENT):
            return f"{name} is {there.get(name, _ABSENT)} there and {here.get(name, _ABSENT)} here"
    return None


def _check_config(folder: Path, saved: dict[str, Any], config: Config) -> None:
    difference = first_difference(saved, config)
    if difference is not None:
        raise CheckpointError(
            f"checkpoint {folder} is of another config: {difference}; use its config or another folder"
        )


def _check_arrays(folder: Path, saved: dict[str, list[Any]], expected: dict[str, list[Any]]) -> None:
    for name in [*expected, *saved]:
        if saved.get(name) != expected.get(name):
            raise CheckpointError(
                f"checkpoint {folder} does not fit this version of vsearch_jax: {name} is {saved.get(name)} there "
                f"and {expected.get(name)} here; use the version that wrote it"
            )


def _manager(run: Path) -> ocp.CheckpointManager:
    # Not asynchronous: the next chunk donates the arrays, and a save takes well under a second.
    options = ocp.CheckpointManagerOptions(max_to_keep=NUM_KEPT, enable_async_checkpointing=False)
    return ocp.CheckpointManager((run / CHECKPOINTS).absolute(), options=options)


def _read(run: Path, step: int, item: str, arguments: ocp.args.CheckpointArgs) -> Any:
    folder = run / CHECKPOINTS / str(step)
    try:
        _check_stored_arrays(folder)
        with _one_error(), _manager(run) as manager:
            return manager.restore(step, args=ocp.args.Composite(**{item: arguments}))[item]
    except (PermissionError, MemoryError):
        raise
    except Exception as error:  # a damaged file shows as any of a dozen types, from JSON's to tensorstore's
        earlier = [other for other in _steps(run) if other < step]
        again = f"delete that folder and go on from {max(earlier, default=0)}: vsearch train --out {run} --resume"
        remedy = again if earlier else "there is no other; train anew"
        raise CheckpointError(f"checkpoint {folder} is damaged ({_first_line(error)}); {remedy}") from error


@contextlib.contextmanager
def _one_error() -> Iterator[None]:
    # Of the arrays that orbax writes at once the first that fails raises. It also logs a traceback for each of its
    # threads, and the arrays still under way find their event loop closed, which Python reports as unraisable.
    logs, hook = [logging.getLogger(name) for name in ("absl", "asyncio")], sys.unraisablehook
    levels = [log.level for log in logs]
    for log in logs:
        log.setLevel(logging.CRITICAL)
    sys.unraisablehook = lambda report: None if str(report.exc_value) == "Event loop is closed" else hook(report)
    yield
    # After an error both stay: the last of those threads may end, and its traceback come, long after this block.
    sys.unraisablehook = hook
    for log, level in zip(logs, levels, strict=True):
        log.setLevel(level)


def _check_stored_arrays(folder: Path) -> None:
    # orbax reads arrays concurrently; where one fails, the callbacks of the others later print tracebacks from threads.
    store = tensorstore.KvStore.open({"driver": "ocdbt", "base": f"file://{(folder / 'state').absolute()}/"}).result()
    for read in [store.read(name) for name in store.list().result()]:
        read.result()


def _named_leaves(tree: Any) -> dict[str, Any]:
    leaves = jax.tree_util.tree_leaves_with_path(tree)
    return {jax.tree_util.keystr(path, simple=True, separator="."): leaf for path, leaf in leaves}


def _not_empty(arrays: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    # orbax refuses arrays without entries; their shape and type, which the template knows, are all there is to them.
    return {name: array for name, array in arrays.items() if array.size > 0}


def _is_key(leaf: Any) -> bool:
    return jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def _data(leaf: Any) -> Any:
    return jax.random.key_data(leaf) if _is_key(leaf) else leaf


def _leaf(stored: np.ndarray, key_impl: str | None) -> jax.Array:
    array = jnp.array(stored)
    return array if key_impl is None else jax.random.wrap_key_data(array, impl=key_impl)


def _describe(array: Any) -> list[Any]:
    return [list(array.shape), str(array.dtype)]


def _as_json(values: dict[str, Any]) -> dict[str, Any]:
    return json.loads(json.dumps(values))


def _flatten(values: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for name, value in values.items():
        flat |= _flatten(value, f"{prefix}{name}.") if isinstance(value, dict) else {prefix + name: value}
    return flat


def _first_line(error: Exception) -> str:
    lines = str(error).strip().splitlines()
    return lines[0][:200] if lines else type(error).__name__
