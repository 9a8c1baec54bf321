"""Which geoms can touch each other, by MuJoCo's rules: contact bits, weld groups, neighbours, excludes and pairs."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import mujoco
import numpy as np

from vsearch_jax.robot.collision.motion_bounds import extent_from_still_point

NEVER_NEAR = 0.05
"""m. Planning ignores pairs whose distance is never smaller than this, because they never limit a motion."""
RESTING = 2e-5
"""m. A pair that is never farther apart than this, and never in contact, is left out."""
NUM_CONFIGURATIONS = 64
"""Number of random configurations that stand for all of them."""


class Geoms(NamedTuple):
    """MuJoCo's numbers of the geoms, grouped by the part of the scene that they belong to.

    Attributes:
      arm: geoms of the arm, its fixed base included.
      mount: geoms of the mount.
      object: geoms of the object.
      obstacles: geoms of the obstacles.
    """

    arm: tuple[int, ...]
    mount: tuple[int, ...]
    object: tuple[int, ...]
    obstacles: tuple[int, ...]


def touching_pairs(
    model: mujoco.MjModel, data: mujoco.MjData, geoms: Geoms, is_for_planning: bool
) -> list[tuple[int, int]]:
    """Lists the pairs of geoms that can touch. Pairs with the table are not listed, nor pairs that rest on each other.

    Args:
      model: the compiled scene.
      data: MuJoCo's data of the scene, with the kinematics computed at `qpos0`.
      geoms: numbers of the geoms of arm, mount, object and obstacles.
      is_for_planning: whether to leave out pairs whose distance is never below `NEVER_NEAR` (0.05 m).

    Returns:
      Pairs of MuJoCo's geom numbers. The first geom of a pair belongs to the arm and is moved by a joint. Each pair is
      listed once.
    """
    moving = _moving_geoms(model, geoms)
    fixed = [*(g for g in geoms.arm if g not in moving), *geoms.mount, *geoms.object, *geoms.obstacles]
    pairs = [(a, b) for i, a in enumerate(moving) for b in [*moving[i + 1 :], *fixed]]
    # MuJoCo applies no filter to the pairs of <contact><pair>.
    explicit = {frozenset(pair) for pair in zip(model.pair_geom1.tolist(), model.pair_geom2.tolist(), strict=True)}
    pairs = [(a, b) for a, b in pairs if frozenset((a, b)) in explicit or _can_touch(model, a, b)]
    resting = _resting_pairs(model, data, pairs)
    pairs = [pair for pair in pairs if pair not in resting]
    return [pair for pair in pairs if not is_for_planning or _can_come_near(model, data, pair)]


def table_geoms(model: mujoco.MjModel, data: mujoco.MjData, geoms: Geoms, is_for_planning: bool) -> list[int]:
    """Lists the geoms of the arm that are moved by a joint and can touch the table.

    Args:
      model: the compiled scene.
      data: MuJoCo's data of the scene, with the kinematics computed at `qpos0`.
      geoms: numbers of the geoms of arm, mount, object and obstacles.
      is_for_planning: whether to leave out geoms whose distance from the table is never below `NEVER_NEAR` (0.05 m).

    Returns:
      MuJoCo's numbers of the geoms.
    """
    moving = [g for g in _moving_geoms(model, geoms) if model.geom_contype[g] | model.geom_conaffinity[g]]
    return [g for g in moving if not is_for_planning or _min_height(model, data, g) < NEVER_NEAR]


def _moving_geoms(model: mujoco.MjModel, geoms: Geoms) -> list[int]:
    """Returns the geoms of the arm that at least one joint moves."""
    return [g for g in geoms.arm if model.body_weldid[model.geom_bodyid[g]] != 0]


def _resting_pairs(
    model: mujoco.MjModel, data: mujoco.MjData, pairs: Sequence[tuple[int, int]]
) -> set[tuple[int, int]]:
    """Returns the pairs that lie against each other without contact in every configuration.

    Links of some arms turn face to face, nanometres apart. Distances are exact to `RESTING` only, so such a pair would
    count as touching for ever. C MuJoCo measures the distances of random configurations.
    """

    def rests(data: mujoco.MjData, pair: tuple[int, int]) -> bool:
        gap = np.linalg.norm(data.geom_xpos[pair[0]] - data.geom_xpos[pair[1]]) - model.geom_rbound[list(pair)].sum()
        return gap <= RESTING and 0.0 < mujoco.mj_geomDistance(model, data, *pair, 2.0 * RESTING, None) <= RESTING

    resting = {pair for pair in pairs if rests(data, pair)}
    for other in random_configurations(model) if resting else ():
        resting = {pair for pair in resting if rests(other, pair)}
    return resting


def random_configurations(model: mujoco.MjModel) -> Iterator[mujoco.MjData]:
    """Yields the kinematics of `NUM_CONFIGURATIONS` random joint values inside the limits, the same ones each time.

    Args:
      model: a model whose joints are hinges or slides. The same data is yielded again and again.
    """
    data, random = mujoco.MjData(model), np.random.default_rng(0)
    is_limited = model.jnt_limited.astype(bool)[:, None]
    low, high = np.where(is_limited, model.jnt_range, [-np.pi, np.pi]).T
    for _ in range(NUM_CONFIGURATIONS):
        data.qpos[model.jnt_qposadr] = random.uniform(low, high)
        mujoco.mj_kinematics(model, data)
        yield data


def _can_come_near(model: mujoco.MjModel, data: mujoco.MjData, pair: tuple[int, int]) -> bool:
    """Returns False if the distance of the pair is never smaller than `NEVER_NEAR`."""
    moving, other = pair
    if model.body_weldid[model.geom_bodyid[other]] != 0:
        return True
    point, extent = extent_from_still_point(model, data, moving)
    distance = float(np.linalg.norm(data.geom_xpos[other] - point)) - float(model.geom_rbound[other])
    return distance - extent < NEVER_NEAR


def _min_height(model: mujoco.MjModel, data: mujoco.MjData, geom: int) -> float:
    """Returns a lower bound in m of the height of `geom` above the table."""
    point, extent = extent_from_still_point(model, data, geom)
    return float(point[2]) - float(model.geom("table").pos[2]) - extent


def _can_touch(model: mujoco.MjModel, a: int, b: int) -> bool:
    """Applies MuJoCo's collision filter: contact bits, weld groups, parent and child, excluded bodies."""
    if not (model.geom_contype[a] & model.geom_conaffinity[b] or model.geom_contype[b] & model.geom_conaffinity[a]):
        return False
    body_a, body_b = int(model.geom_bodyid[a]), int(model.geom_bodyid[b])
    weld_a, weld_b = int(model.body_weldid[body_a]), int(model.body_weldid[body_b])
    if weld_a == weld_b:
        return False
    parent_a = int(model.body_weldid[model.body_parentid[weld_a]])
    parent_b = int(model.body_weldid[model.body_parentid[weld_b]])
    if weld_a and weld_b and (parent_a == weld_b or parent_b == weld_a):
        return False
    signature = (min(body_a, body_b) << 16) + max(body_a, body_b)
    return signature not in model.exclude_signature
