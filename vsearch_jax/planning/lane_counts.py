"""How many problems planning solves at once, by platform.

A count is a Python integer that becomes an array's shape, so it is read at trace time. The platform is that of
`jax.default_backend()`: a program that is exported on a CPU for a GPU has the CPU's counts.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import NamedTuple

import jax


class LaneCounts(NamedTuple):
    """Upper limits of the number of problems that are solved at once. Each of these problems occupies one lane.

    Attributes:
      ik: number of lanes of `ik`.
      rrt: number of lanes of `rrt` and `rrt_connect`.
      azimuths: number of azimuths of the reachability map at once; None solves the whole map at once.
    """

    ik: int
    rrt: int
    azimuths: int | None


# Measured on two cores. 256 lanes of IK fit the cache. More than 64 lanes of RRT cost less each, but more of them idle
# at the end. 12 azimuths with 19 elevations and 11 starts take about 60 MB.
CPU = LaneCounts(ik=256, rrt=64, azimuths=12)
# An accelerator needs thousands of lanes to be busy.
ACCELERATOR = LaneCounts(ik=4096, rrt=2048, azimuths=None)

_overridden: list[LaneCounts] = []


def current() -> LaneCounts:
    """Returns how many problems IK, RRT and the reachability map solve at once.

    The counts are those of the innermost `override`. Outside an `override` they are those of the platform.
    """
    if _overridden:
        return _overridden[-1]
    return CPU if jax.default_backend() == "cpu" else ACCELERATOR


@contextlib.contextmanager
def override(**counts: int | None) -> Iterator[LaneCounts]:
    """Replaces, inside a `with` block, how many problems IK, RRT and the reachability map solve at once.

    It serves measurements. JAX does not know that a traced function depends on the counts. So the caches of JAX are
    cleared at both ends of the block, and every jitted function is traced again. The counts hold for all threads.

    Args:
      **counts: new values of fields of `LaneCounts`; the other fields stay.

    Yields:
      All counts, as they hold inside the block.

    Raises:
      ValueError: a name is no field of `LaneCounts`, or a count is below 1.
    """
    for name, count in counts.items():
        is_count = isinstance(count, int) and count >= 1
        if name not in LaneCounts._fields or not (is_count or (name == "azimuths" and count is None)):
            raise ValueError(
                f"lane_counts.override: {name} is {count}; allowed are {', '.join(LaneCounts._fields)}, each a whole "
                "number from 1 on; azimuths may also be None"
            )
    _overridden.append(current()._replace(**counts))
    jax.clear_caches()
    try:
        yield _overridden[-1]
    finally:
        _overridden.pop()
        jax.clear_caches()
