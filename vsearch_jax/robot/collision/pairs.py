"""The pairs of geoms that must not touch, as arrays for distances and for planning."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import flax.struct
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array

from vsearch_jax.robot.collision.candidates import Geoms
from vsearch_jax.robot.collision.groups import PairGroups, group_pairs
from vsearch_jax.robot.collision.motion_bounds import lever_arms
from vsearch_jax.robot.collision.solids import CYLINDER, ELLIPSOID, SPHERE, build_side, convex_solid
from vsearch_jax.robot.collision.support import Side
from vsearch_jax.robot.kinematics import Placement, build_placement, rotate

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
class Bodies:
    """The S geoms of the pairs in `Pairs.convex`. At least one geom of such a pair is neither capsule nor sphere.

    Attributes:
      geom: i32[S], MuJoCo's numbers of the geoms.
      placement: Placement of the geoms.
      box_center: f32[S, 3] m, centre of the geom's bounding box in the geom's frame.
      box_size: f32[S, 3] m, half sizes of this box.
    """

    geom: Array
    placement: Placement
    box_center: Array
    box_size: Array


@flax.struct.dataclass
class ConvexPairs:
    """P pairs of convex solids.

    Attributes:
      first: i32[P], row in `Pairs.bodies` of the geom with more vertices.
      second: i32[P], row in `Pairs.bodies` of the other geom; the table's pairs have none.
      first_side: Side of the first geoms.
      second_side: Side of the second geoms; None for the table's pairs.
    """

    first: Array
    second: Array
    first_side: Side
    second_side: Side | None


@flax.struct.dataclass
class Pairs:
    """The N pairs of solids that must not touch, and the C capsules that take part in them.

    The order of the pairs is: table, capsules, boxes, cylinders, ellipsoids, then `convex`. J joints, the chain, move
    the wrist camera. A sphere counts as a capsule.

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
      boxes: pairs of a capsule and a box of mount, object or obstacles. An object's mesh and a height field count as
        their bounding boxes.
      cylinders: pairs of a capsule and a cylinder of mount, object or obstacles.
      ellipsoids: pairs of a capsule and an ellipsoid of mount, object or obstacles.
      bodies: the S geoms of the pairs in `convex`.
      convex: all other pairs, in groups of solids of similar size. Without such pairs it is empty and costs nothing.
      part: i32[N], what the arm would touch: TABLE, OBJECT, SELF (the mount included) or OBSTACLE.
      levers: f32[N, J], upper bound of the change of the distance in m for each unit (rad or m) of each chain joint.
      mover: i32[N], row of the moving geom of the pair, of the first geom if both move: C capsules, then S bodies.
      is_still: bool[N], whether the other solid of the pair is fixed.
      reach: f32[C + S, J], upper bound of the motion in m of any point of the capsule or body for each unit (rad or m)
        of each chain joint.
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
    bodies: Bodies
    convex: tuple[ConvexPairs, ...]
    part: Array
    levers: Array
    mover: Array
    is_still: Array
    reach: Array


def build_pairs(
    model: mujoco.MjModel, data: mujoco.MjData, geoms: Geoms, joints: tuple[int, ...], is_for_planning: bool
) -> Pairs:
    """Builds the list of geom pairs that can touch, so that their distances can be computed.

    MuJoCo's rules decide which pairs can touch: contact bits, weld groups, neighbours, excluded bodies and `<pair>`.

    Args:
      model: the compiled scene.
      data: MuJoCo's data of the scene, with the kinematics computed at `qpos0`.
      geoms: numbers of the geoms of arm, mount, object and obstacles.
      joints: MuJoCo's numbers of the J joints that planning moves.
      is_for_planning: whether to leave out pairs whose distance is never below `NEVER_NEAR` (0.05 m), and to replace
        ellipsoids around the arm by enclosing capsules. The distance from the capsule is never larger than that from
        the ellipsoid.

    Returns:
      The pairs, with bounds of how fast each joint changes their distances.
    """
    groups = group_pairs(model, data, geoms, is_for_planning)
    row = {geom: i for i, geom in enumerate(groups.capsule_geoms)}
    body_row = {geom: i for i, geom in enumerate(groups.body_geoms)}
    mover_row = {**{geom: len(row) + i for geom, i in body_row.items()}, **row}
    ordered = groups.in_order()
    center, half_axis, radius = _enclosing_capsules(model, groups.capsule_geoms)
    placement = _placement(model, data, groups.capsule_geoms)
    arms = lever_arms(model, data, joints)
    return Pairs(
        geom=jnp.asarray(groups.capsule_geoms, jnp.int32),
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
        bodies=_build_bodies(model, data, groups.body_geoms),
        convex=_build_convex(model, geoms, groups, body_row),
        part=jnp.asarray([_part(geoms, b) for _, b in ordered], jnp.int32),
        levers=jnp.asarray([_relative_levers(arms, a, b) for a, b in ordered], jnp.float32).reshape(-1, len(joints)),
        mover=jnp.asarray([mover_row[a] for a, _ in ordered], jnp.int32),
        is_still=jnp.asarray([b is None or not arms[b].any() for _, b in ordered], bool),
        reach=jnp.asarray(arms[[*groups.capsule_geoms, *groups.body_geoms]], jnp.float32),
    )


def _placement(model: mujoco.MjModel, data: mujoco.MjData, geoms: Sequence[int]) -> Placement:
    return jax.tree.map(lambda leaf: leaf[np.asarray(geoms, np.int32)], build_placement(model, data, "geom"))


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
    capsules = [_enclosing_capsule(model, geom) for geom in geoms]
    return (
        jnp.zeros((len(geoms), 3), jnp.float32),
        jnp.asarray(np.array([half_axis for half_axis, _ in capsules]).reshape(-1, 3), jnp.float32),
        jnp.asarray([radius for _, radius in capsules], jnp.float32),
    )


def _enclosing_capsule(model: mujoco.MjModel, geom: int) -> tuple[np.ndarray, float]:
    """Returns the half axis f64[3] m and the radius in m of a capsule around a sphere, a capsule or an ellipsoid."""
    kind, size = int(model.geom_type[geom]), model.geom_size[geom]
    if kind == SPHERE:
        return np.zeros(3), float(size[0])
    if kind != ELLIPSOID:
        return np.array([0.0, 0.0, size[1]]), float(size[0])
    # The radius is the middle radius of the ellipsoid. The ends of the capsule touch the tips of the ellipsoid.
    longest = int(np.argmax(size))
    radius = float(np.delete(size, longest).max())
    half_axis = np.zeros(3)
    half_axis[longest] = size[longest] - radius
    return half_axis, radius


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


def _build_bodies(model: mujoco.MjModel, data: mujoco.MjData, geoms: list[int]) -> Bodies:
    box = model.geom_aabb[np.asarray(geoms, np.int32)]
    return Bodies(
        geom=jnp.asarray(geoms, jnp.int32),
        placement=_placement(model, data, geoms),
        box_center=jnp.asarray(box[:, :3], jnp.float32),
        box_size=jnp.asarray(box[:, 3:], jnp.float32),
    )


def _build_convex(
    model: mujoco.MjModel, geoms: Geoms, groups: PairGroups, body_row: dict[int, int]
) -> tuple[ConvexPairs, ...]:
    """Returns the groups of pairs of convex solids. An object's mesh counts as its bounding box."""
    solids = {geom: convex_solid(model, geom, is_box=geom in geoms.object) for geom in groups.body_geoms}

    def num_points(geom: int | None) -> int:
        return 0 if geom is None else len(solids[geom].points)

    def build(pairs: Sequence[tuple[int, int | None]]) -> ConvexPairs:
        # The larger solid comes first, so that each side is padded as little as possible.
        by_size = [sorted(pair, key=num_points, reverse=True) for pair in pairs]
        larger = [first for first, _ in by_size if first is not None]
        smaller = [second for _, second in by_size if second is not None]
        return ConvexPairs(
            first=jnp.asarray([body_row[g] for g in larger], jnp.int32),
            second=jnp.asarray([body_row[g] for g in smaller], jnp.int32),
            first_side=build_side([solids[g] for g in larger]),
            second_side=build_side([solids[g] for g in smaller]) if smaller else None,
        )

    return tuple(build(pairs) for pairs in groups.convex)
