"""Names of the arrays in checkpoints of earlier versions.

A checkpoint stores each array under its path in the pytree. Where a version renamed a field, the table here maps the
old name to the new one.
"""

from __future__ import annotations

from collections.abc import Iterable

UNVERSIONED = "0.1.0"
"""The version whose checkpoints store no version."""

_RENAMES = {
    UNVERSIONED: (
        (".sight.", ".observation."),
        ("replay.data.observation", "replay.data.obs"),
        ("replay.data.next_observation", "replay.data.next_obs"),
    )
}
"""For each version: parts of old names, and what replaces them."""

_DROPPED = {UNVERSIONED: ("replay.data.truncated",)}
"""For each version: arrays that no later version reads."""


def current_names(stored: Iterable[str], version: str) -> dict[str, str]:
    """Maps the array names in a checkpoint of an earlier version to the names that this version reads.

    Arrays that this version no longer reads are left out.

    Args:
      stored: names of the arrays in the checkpoint.
      version: version of vsearch_jax that wrote the checkpoint.

    Returns:
      {name in the checkpoint: name in this version}.
    """
    names = {}
    for name in stored:
        if name in _DROPPED.get(version, ()):
            continue
        current = name
        for old, new in _RENAMES.get(version, ()):
            current = current.replace(old, new)
        names[name] = current
    return names
