"""The pairs of geoms that must not touch, as arrays for distances and for planning."""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import flax.struct
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array

from vsearch_jax.robot.collision.candidates import Geoms, table_geoms, touching_pairs
from vsearch_jax.robot.collision.motion_bounds import lever_arms
from vsearch_jax.robot.kinematics import Placement, build_placement, rotate

SPHERE = int(mujoco.mjtGeom.mjGEOM_SPHERE)
CAPSULE = int(mujoco.mjtGeom.mjGEOM_CAPSULE)
CYLINDER = int(mujoco.mjtGeom.mjGEOM_CYLINDER)
ELLIPSOID = int(mujoco.mjtGeom.mjGEOM_ELLIPSOID)
TABLE, OBJECT, SELF, OBSTACLE = range(4)


@flax.struct.dataclass
class Solids:
    """N pairs of a capsule and a fixed solid: a box, a cylinder or an ellipsoid.

    Attributes:
      capsule: i32[N], row of the capsule in `Pairs.geom`.
      position: f32[N, 3] m, centre of the solid in world.
      rotation: f32[N, 3, 3], solid to world.
      size: f32[N, 3] m. Half sizes of a box; radii of an ellipsoid; radius and half length of a cylinder.
    """

    capsule: Array
    position: Array
    rotation: Array
    size: Array


@flax.struct.dataclass
class Pairs:
    """The N pairs of solids that must not touch, and the C capsules that take part in them.

    The order of the pairs is: table, capsules, boxes, cylinders, ellipsoids. J joints, the chain,
    move the wrist camera.

    Attributes:
      geom: i32[C], MuJoCo's number of the geom of each capsule.
      center: f32[C, 3] m, midpoint of the capsule in the geom's frame.
      half_axis: f32[C, 3] m, vector from the midpoint to one end of the axis, in the geom's frame.
      radius: f32[C] m, radius of the capsule.
      placement: Placement of the capsules, with their midpoints as positions. It serves callers without geom poses.
      frame_half_axis: f32[C, 3] m, `half_axis` in the joint frame of `placement`.
      table: i32[M], rows of the M capsules that must stay above the table.
      first: i32[P], row of the first capsule of each of P pairs of capsules.
      second: i32[P], row of the second capsule of each of P pairs of capsules.
      boxes: pairs of a capsule and a box. A mesh counts as its bounding box.
      cylinders: pairs of a capsule and a cylinder.
      ellipsoids: pairs of a capsule and an ellipsoid.
      part: i32[N], what the arm would touch: TABLE, OBJECT, SELF (the mount included) or OBSTACLE.
      levers: f32[N, J], upper bound of the change of the distance in m for each unit (rad or m) of each chain joint.
      mover: i32[N], row of the moving capsule of the pair; of the first capsule if both move.
      is_still: bool[N], whether the other solid of the pair is fixed.
      reach: f32[C, J], upper bound of the motion in m of any point of the capsule for each unit (rad or m) of each
        chain joint.
    """

    geom: Array
    center: Array
    half_axis: Array
    radius: Array
    placement: Placement
    frame_half_axis: Array
    table: Array
    first: Array
    second: Array
    boxes: Solids
    cylinders: Solids
    ellipsoids: Solids
    part: Array
    levers: Array
    mover: Array
    is_still: Array
    reach: Array


class _PairGroups(NamedTuple):
    """Pairs of geoms, grouped by the kind of the second geom.

    Attributes:
      table: geoms that must stay above the table.
      capsules: pairs of two capsules.
      boxes: pairs of a capsule and a box or mesh.
      cylinders: pairs of a capsule and a cylinder.
      ellipsoids: pairs of a capsule and an ellipsoid.
    """

    table: list[int]
    capsules: list[tuple[int, int]]
    boxes: list[tuple[int, int]]
    cylinders: list[tuple[int, int]]
    ellipsoids: list[tuple[int, int]]

    def in_order(self) -> list[tuple[int, int | None]]:
        """Returns all pairs in the order of `Pairs`; the table is None."""
        return [*((g, None) for g in self.table), *self.capsules, *self.boxes, *self.cylinders, *self.ellipsoids]


def build_pairs(
    model: mujoco.MjModel, data: mujoco.MjData, geoms: Geoms, joints: tuple[int, ...], is_for_planning: bool
) -> Pairs:
    """Builds the list of geom pairs that can touch, so that their distances can be computed.

    MuJoCo's rules decide which pairs can touch: contact bits, weld groups, neighbours and excluded bodies. Each geom of
    the arm becomes its enclosing capsule.

    Args:
      model: the compiled scene.
      data: MuJoCo's data of the scene, with the kinematics computed at `qpos0`.
      geoms: numbers of the geoms of arm, mount, object and obstacles.
      joints: MuJoCo's numbers of the J joints that planning moves.
      is_for_planning: whether to leave out pairs whose distance is never below `NEVER_NEAR` (0.05 m), and to replace
        ellipsoids by enclosing capsules. The distance from the capsule is never larger than that from the ellipsoid.

    Returns:
      The pairs, with bounds of how fast each joint changes their distances.
    """
    capsules = _capsule_geoms(model, geoms, is_for_planning)
    row = {geom: i for i, geom in enumerate(capsules)}
    groups = _group_pairs(model, data, geoms, row, is_for_planning)
    ordered = groups.in_order()
    center, half_axis, radius = _enclosing_capsules(model, capsules)
    placement = jax.tree.map(lambda leaf: leaf[np.asarray(capsules)], build_placement(model, data, "geom"))
    arms = lever_arms(model, data, joints)
    return Pairs(
        geom=jnp.asarray(capsules, jnp.int32),
        center=center,
        half_axis=half_axis,
        radius=radius,
        placement=dataclasses.replace(placement, position=placement.position + rotate(placement.rotation, center)),
        frame_half_axis=rotate(placement.rotation, half_axis),
        table=jnp.asarray([row[g] for g in groups.table], jnp.int32),
        first=jnp.asarray([row[a] for a, _ in groups.capsules], jnp.int32),
        second=jnp.asarray([row[b] for _, b in groups.capsules], jnp.int32),
        boxes=_build_solids(model, data, groups.boxes, row),
        cylinders=_build_solids(model, data, groups.cylinders, row),
        ellipsoids=_build_solids(model, data, groups.ellipsoids, row),
        part=jnp.asarray([_part(geoms, b) for _, b in ordered], jnp.int32),
        levers=jnp.asarray([_relative_levers(arms, a, b) for a, b in ordered], jnp.float32).reshape(-1, len(joints)),
        mover=jnp.asarray([row[a] for a, _ in ordered], jnp.int32),
        is_still=jnp.asarray([b is None or not arms[b].any() for _, b in ordered], bool),
        reach=jnp.asarray(arms[capsules], jnp.float32),
    )


def _capsule_geoms(model: mujoco.MjModel, geoms: Geoms, is_for_planning: bool) -> list[int]:
    """Returns the geoms that count as capsules: all of the arm, and round geoms of its surroundings."""
    kinds = {SPHERE, CAPSULE, ELLIPSOID} if is_for_planning else {SPHERE, CAPSULE}
    surroundings = (*geoms.mount, *geoms.object, *geoms.obstacles)
    return [*geoms.arm, *(g for g in surroundings if int(model.geom_type[g]) in kinds)]


def _group_pairs(
    model: mujoco.MjModel, data: mujoco.MjData, geoms: Geoms, row: dict[int, int], is_for_planning: bool
) -> _PairGroups:
    """Returns the pairs that can touch. `row` has an entry for each geom that counts as a capsule."""
    pairs = touching_pairs(model, data, geoms, is_for_planning)
    solid_pairs = [(a, b) for a, b in pairs if b not in row]
    kinds = [int(model.geom_type[b]) for _, b in solid_pairs]
    return _PairGroups(
        table=table_geoms(model, data, geoms, is_for_planning),
        capsules=[(a, b) for a, b in pairs if b in row],
        boxes=[pair for pair, kind in zip(solid_pairs, kinds, strict=True) if kind not in (CYLINDER, ELLIPSOID)],
        cylinders=[pair for pair, kind in zip(solid_pairs, kinds, strict=True) if kind == CYLINDER],
        ellipsoids=[pair for pair, kind in zip(solid_pairs, kinds, strict=True) if kind == ELLIPSOID],
    )


def _part(geoms: Geoms, other: int | None) -> int:
    """Returns what the arm touches if it touches geom `other`; None is the table."""
    if other is None:
        return TABLE
    return OBJECT if other in geoms.object else OBSTACLE if other in geoms.obstacles else SELF


def _relative_levers(arms: np.ndarray, a: int, b: int | None) -> np.ndarray:
    """Returns f64[J], lever arms of the distance of geoms `a` and `b`; None is the table."""
    if b is None:
        return arms[a]
    # A joint that moves both geoms does not change their distance.
    return np.where((arms[a] > 0.0) & (arms[b] > 0.0), 0.0, arms[a] + arms[b])


def _enclosing_capsules(model: mujoco.MjModel, geoms: list[int]) -> tuple[Array, Array, Array]:
    """Returns midpoints f32[C, 3] m, half axes f32[C, 3] m and radii f32[C] m of capsules around `geoms`."""
    centers, half_axes, radii = zip(*(_enclosing_capsule(model, geom) for geom in geoms), strict=True)
    return (
        jnp.asarray(np.array(centers), jnp.float32),
        jnp.asarray(np.array(half_axes), jnp.float32),
        jnp.asarray(np.array(radii), jnp.float32),
    )


def _enclosing_capsule(model: mujoco.MjModel, geom: int) -> tuple[np.ndarray, np.ndarray, float]:
    """Returns midpoint f64[3] m, half axis f64[3] m and radius in m of a capsule around `geom`, in its frame."""
    kind, size = int(model.geom_type[geom]), model.geom_size[geom]
    if kind == SPHERE:
        return np.zeros(3), np.zeros(3), float(size[0])
    if kind in (CAPSULE, CYLINDER):
        return np.zeros(3), np.array([0.0, 0.0, size[1]]), float(size[0])
    center, half_sizes = model.geom_aabb[geom, :3], model.geom_aabb[geom, 3:]
    longest = int(np.argmax(half_sizes))
    others = np.delete(half_sizes, longest)
    half_axis = np.zeros(3)
    if kind == ELLIPSOID:
        # The radius is the middle radius of the ellipsoid. The ends of the capsule touch the tips of the ellipsoid.
        half_axis[longest] = half_sizes[longest] - others.max()
        return center, half_axis, float(others.max())
    half_axis[longest] = half_sizes[longest]
    return center, half_axis, float(np.hypot(*others))


def _build_solids(
    model: mujoco.MjModel, data: mujoco.MjData, pairs: list[tuple[int, int]], row: dict[int, int]
) -> Solids:
    """Returns `pairs` of a capsule and a solid. A solid that is no cylinder or ellipsoid counts as its bounding box."""
    geoms = np.array([b for _, b in pairs], dtype=np.int32)
    is_exact = np.isin(model.geom_type[geoms], (CYLINDER, ELLIPSOID))[:, None]
    box = model.geom_aabb[geoms]
    rotation = data.geom_xmat[geoms].reshape(-1, 3, 3)
    center = np.where(is_exact, 0.0, box[:, :3])
    return Solids(
        capsule=jnp.asarray([row[a] for a, _ in pairs], jnp.int32),
        position=jnp.asarray(data.geom_xpos[geoms] + np.einsum("nij,nj->ni", rotation, center), jnp.float32),
        rotation=jnp.asarray(rotation, jnp.float32),
        size=jnp.asarray(np.where(is_exact, model.geom_size[geoms], box[:, 3:]), jnp.float32),
    )
