"""Runs of earlier versions: names of the arrays in their checkpoints, and fields that their configs do not have.

A checkpoint stores each array under its path in the pytree. Where a version renamed a field, the table here maps the
old name to the new one.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

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

_LATER_FIELDS: dict[str, dict[str, object]] = {
    "scene": {"symmetry": None, "mesh_up": "z"},
    "encoder": {
        "loss": "autoencoder",
        "intensity": "linear",
        "optimizer": "adam",
        "hidden_sizes": [],
        "threshold_angle_deg": 3.0,
        "wide_weight": 0.3,
        "shaded_share": 0.0,
    },
    "planning": {"num_goals": 1},
    "env": {"target": "random"},
    "random_search": {"num_wide": 0},
    "cma_es": {"constraint": "bounds"},
    "sac": {"algorithm": "twin_q", "network": "plain", "pool_fraction": 0.0, "imitation_weight": 0.0},
}
"""Fields of the config that came after version 0.2.0, with the values that mean what earlier versions did."""


def with_later_fields(config: Mapping[str, object]) -> dict[str, object]:
    """Returns a stored config with the fields that its version did not have yet.

    Args:
      config: nested plain values, as `Config.to_dict` of any version gives them.
    """
    full = dict(config)
    for section, fields in _LATER_FIELDS.items():
        present = full.get(section, {})
        if isinstance(present, dict):
            full[section] = fields | present
    return full


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
