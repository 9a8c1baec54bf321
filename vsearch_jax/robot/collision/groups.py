"""The pairs of geoms that can touch, grouped by the method that computes their distance."""

from __future__ import annotations

from typing import NamedTuple

import mujoco

from vsearch_jax.robot.collision.candidates import Geoms, table_geoms, touching_pairs
from vsearch_jax.robot.collision.solids import CAPSULE, CYLINDER, ELLIPSOID, MESH, SPHERE, hull_vertices
from vsearch_jax.robot.collision.support import BLOCK


class PairGroups(NamedTuple):
    """Pairs of geoms, grouped by the method that computes their distance. The first geom of a pair moves.

    Attributes:
      capsule_geoms: geoms that count as capsules.
      body_geoms: geoms of the pairs in `convex`.
      table: capsules that must stay above the table.
      capsules: pairs of two capsules.
      boxes: pairs of a capsule and a fixed solid that counts as a box.
      cylinders: pairs of a capsule and a fixed cylinder.
      ellipsoids: pairs of a capsule and a fixed ellipsoid.
      convex: groups of all other pairs. The second geom is None in pairs with the table, which are a group of theirs.
    """

    capsule_geoms: list[int]
    body_geoms: list[int]
    table: list[int]
    capsules: list[tuple[int, int]]
    boxes: list[tuple[int, int]]
    cylinders: list[tuple[int, int]]
    ellipsoids: list[tuple[int, int]]
    convex: list[list[tuple[int, int | None]]]

    def in_order(self) -> list[tuple[int, int | None]]:
        """Returns all pairs in the order of `Pairs`; the table is None."""
        in_convex = [pair for group in self.convex for pair in group]
        return [
            *((g, None) for g in self.table),
            *self.capsules,
            *self.boxes,
            *self.cylinders,
            *self.ellipsoids,
            *in_convex,
        ]


def group_pairs(model: mujoco.MjModel, data: mujoco.MjData, geoms: Geoms, is_for_planning: bool) -> PairGroups:
    """Lists the pairs that can touch, grouped by the method that computes their distance.

    Args:
      model: the compiled scene.
      data: MuJoCo's data of the scene, with the kinematics computed at `qpos0`.
      geoms: numbers of the geoms of arm, mount, object and obstacles.
      is_for_planning: see `build_pairs`.
    """
    capsule_geoms = _capsule_geoms(model, geoms, is_for_planning)
    pairs, table = touching_pairs(model, data, geoms, is_for_planning), table_geoms(model, data, geoms, is_for_planning)
    of_kind: dict[str, list[tuple[int, int]]] = {"capsules": [], "boxes": [], "cylinders": [], "ellipsoids": []}
    convex: dict[tuple[int, int, int], list[tuple[int, int | None]]] = {}
    for a, b in pairs:
        kind = _method(model, geoms, set(capsule_geoms), a, b)
        if kind is None:
            convex.setdefault(_size_class(model, geoms, a, b), []).append((a, b))
        else:
            of_kind[kind].append((a, b))
    of_table: list[tuple[int, int | None]] = [(g, None) for g in table if g not in capsule_geoms]
    groups = [*([of_table] if of_table else []), *(convex[key] for key in sorted(convex))]
    return PairGroups(
        capsule_geoms=capsule_geoms,
        body_geoms=sorted({g for group in groups for pair in group for g in pair if g is not None}),
        table=[g for g in table if g in capsule_geoms],
        capsules=of_kind["capsules"],
        boxes=of_kind["boxes"],
        cylinders=of_kind["cylinders"],
        ellipsoids=of_kind["ellipsoids"],
        convex=groups,
    )


def _capsule_geoms(model: mujoco.MjModel, geoms: Geoms, is_for_planning: bool) -> list[int]:
    """Returns the geoms that count as capsules: spheres and capsules, and for planning ellipsoids around the arm."""
    round_kinds = {SPHERE, CAPSULE}
    around_kinds = {*round_kinds, ELLIPSOID} if is_for_planning else round_kinds
    around = (*geoms.mount, *geoms.object, *geoms.obstacles)
    return [
        *(g for g in geoms.arm if int(model.geom_type[g]) in round_kinds),
        *(g for g in around if int(model.geom_type[g]) in around_kinds),
    ]


def _method(model: mujoco.MjModel, geoms: Geoms, capsule_geoms: set[int], a: int, b: int) -> str | None:
    """Returns the name of the pair's group in `PairGroups`; None if it is `convex`."""
    if a not in capsule_geoms:
        return None
    if b in capsule_geoms:
        return "capsules"
    kind = int(model.geom_type[b])
    if b in geoms.arm or (kind == MESH and b not in geoms.object):
        return None
    return {CYLINDER: "cylinders", ELLIPSOID: "ellipsoids"}.get(kind, "boxes")


def _size_class(model: mujoco.MjModel, geoms: Geoms, a: int, b: int) -> tuple[int, int, int]:
    """Returns how many vertices each solid has (0 few, 1 more, 2 many; sorted), and 1 if one is curved, else 0.

    In a group all solids take as much time as the largest one.
    """

    def size(geom: int) -> int:
        if int(model.geom_type[geom]) != MESH or geom in geoms.object:
            return 0
        num_vertices = len(hull_vertices(model, int(model.geom_dataid[geom])))
        return int(num_vertices > BLOCK) + int(num_vertices > 16 * BLOCK)

    is_curved = any(int(model.geom_type[g]) in (CYLINDER, ELLIPSOID) for g in (a, b))
    smaller, larger = sorted((size(a), size(b)))
    return smaller, larger, int(is_curved)
