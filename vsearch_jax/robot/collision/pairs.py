"""Which solids can touch, and what planning needs to know of each pair of them."""

from __future__ import annotations

from typing import NamedTuple

import flax.struct
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array

from vsearch_jax.robot.collision.motion_bounds import extent_from_still_point, lever_arms
from vsearch_jax.robot.kinematics import Placement, build_placement, rotate

GEOM = mujoco.mjtGeom
TABLE, OBJECT, SELF, OBSTACLE = range(4)
# Planning leaves out pairs that never come nearer than this, in m: they cannot be the ones that stop it.
NEVER_NEAR = 0.05


@flax.struct.dataclass
class Solids:
    """Pairs of a capsule and a solid that stands still; N pairs.

    Attributes:
      capsule: i32[N], row of `Pairs.geom`.
      position: f32[N, 3] m, the solid's middle in world.
      rotation: f32[N, 3, 3], of the solid, to world.
      size: f32[N, 3] m: half sizes of a box, radii of an ellipsoid, radius and half length of a cylinder.
    """

    capsule: Array
    position: Array
    rotation: Array
    size: Array


@flax.struct.dataclass
class Pairs:
    """What must not touch; C capsules, N pairs in the order table, capsules, boxes, cylinders, ellipsoids.

    Attributes:
      geom: i32[C], the geom of each capsule.
      center: f32[C, 3] m, the capsule's middle in the geom's frame.
      half_axis: f32[C, 3] m, from the middle to one end of the axis, in the geom's frame.
      radius: f32[C] m.
      placement: Placement of the capsules themselves, `center` included, for callers who have no poses of geoms.
      frame_half_axis: f32[C, 3] m, `half_axis` in the frame of `placement`.
      table: i32[M], capsules that must stay above the table.
      first: i32[P], one of each pair of capsules.
      second: i32[P], the other one.
      boxes: capsules against boxes, and against the boxes around meshes.
      cylinders: capsules against cylinders.
      ellipsoids: capsules against ellipsoids.
      part: i32[N], what the arm would touch: TABLE, OBJECT, SELF (the mount included) or OBSTACLE.
      levers: f32[N, J], most metres by which a unit of each joint of the chain shortens the distance.
      mover: i32[N], row of the capsule of the pair that moves, of both the first.
      is_still: bool[N], whether the other one stands still.
      reach: f32[C, J], most metres by which a unit of each joint of the chain moves any point of each capsule.
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


class Geoms(NamedTuple):
    """Numbers of the geoms: of the arm, its mount, the object, and whatever else stands around."""

    arm: tuple[int, ...]
    mount: tuple[int, ...]
    object: tuple[int, ...]
    obstacles: tuple[int, ...]


def build_pairs(
    model: mujoco.MjModel, data: mujoco.MjData, geoms: Geoms, joints: tuple[int, ...], is_for_planning: bool
) -> Pairs:
    """Lists the pairs that can touch, by MuJoCo's rules: contact bits, weld groups, neighbours and excluded bodies.

    Args:
      model: the compiled scene.
      data: its kinematics at `qpos0`.
      geoms: which geom is what.
      joints: the joints that planning moves.
      is_for_planning: leave out pairs that never come near, and take ellipsoids for the capsules around them, which is
        on the safe side.
    """
    pairs = [pair for pair in _touching(model, geoms) if not is_for_planning or _can_come_near(model, data, pair)]
    as_capsules = {int(GEOM.mjGEOM_SPHERE), int(GEOM.mjGEOM_CAPSULE)}
    as_capsules |= {int(GEOM.mjGEOM_ELLIPSOID)} if is_for_planning else set()
    standing = (*geoms.mount, *geoms.object, *geoms.obstacles)
    capsules = [*geoms.arm, *(g for g in standing if int(model.geom_type[g]) in as_capsules)]
    row = {g: i for i, g in enumerate(capsules)}
    hulls = [_enclosing_capsule(model, g) for g in capsules]
    round_pairs = [(a, b) for a, b in pairs if b in row]
    solid_pairs = [(a, b) for a, b in pairs if b not in row]
    exact = (int(GEOM.mjGEOM_CYLINDER), int(GEOM.mjGEOM_ELLIPSOID))
    cylinders, ellipsoids = ([pair for pair in solid_pairs if int(model.geom_type[pair[1]]) == kind] for kind in exact)
    boxes = [pair for pair in solid_pairs if int(model.geom_type[pair[1]]) not in exact]
    table = [g for g in _moving(model, geoms) if _meets_table(model, g)]
    if is_for_planning:
        table = [g for g in table if _lowest(model, data, g) < NEVER_NEAR]
    in_order = [*((g, None) for g in table), *round_pairs, *boxes, *cylinders, *ellipsoids]
    arms = lever_arms(model, data, joints)
    placement = jax.tree.map(lambda leaf: leaf[np.asarray(capsules)], build_placement(model, data, "geom"))
    center, half_axis = (jnp.asarray([hull[i] for hull in hulls], jnp.float32) for i in range(2))
    return Pairs(
        geom=jnp.asarray(capsules, jnp.int32),
        center=center,
        half_axis=half_axis,
        radius=jnp.asarray([hull[2] for hull in hulls], jnp.float32),
        placement=placement.replace(position=placement.position + rotate(placement.rotation, center)),
        frame_half_axis=rotate(placement.rotation, half_axis),
        table=jnp.asarray([row[g] for g in table], jnp.int32),
        first=jnp.asarray([row[a] for a, _ in round_pairs], jnp.int32),
        second=jnp.asarray([row[b] for _, b in round_pairs], jnp.int32),
        boxes=_solids(model, data, boxes, row),
        cylinders=_solids(model, data, cylinders, row),
        ellipsoids=_solids(model, data, ellipsoids, row),
        part=jnp.asarray([_part(geoms, b) for _, b in in_order], jnp.int32),
        levers=jnp.asarray([_relative_levers(arms, a, b) for a, b in in_order], jnp.float32).reshape(-1, len(joints)),
        mover=jnp.asarray([row[a] for a, _ in in_order], jnp.int32),
        is_still=jnp.asarray([b is None or not arms[b].any() for _, b in in_order], bool),
        reach=jnp.asarray(arms[capsules], jnp.float32),
    )


def _moving(model: mujoco.MjModel, geoms: Geoms) -> list[int]:
    return [g for g in geoms.arm if model.body_weldid[model.geom_bodyid[g]] != 0]


def _touching(model: mujoco.MjModel, geoms: Geoms) -> list[tuple[int, int]]:
    """Returns pairs of a moving geom of the arm and another geom, each once."""
    moving = _moving(model, geoms)
    still = [*(g for g in geoms.arm if g not in moving), *geoms.mount, *geoms.object, *geoms.obstacles]
    pairs = [(a, b) for i, a in enumerate(moving) for b in [*moving[i + 1 :], *still]]
    return [(a, b) for a, b in pairs if _can_touch(model, a, b)]


def _part(geoms: Geoms, other: int | None) -> int:
    if other is None:
        return TABLE
    return OBJECT if other in geoms.object else OBSTACLE if other in geoms.obstacles else SELF


def _relative_levers(arms: np.ndarray, a: int, b: int | None) -> np.ndarray:
    """Joints that move both geoms leave their distance as it is."""
    if b is None:
        return arms[a]
    return np.where((arms[a] > 0.0) & (arms[b] > 0.0), 0.0, arms[a] + arms[b])


def _can_come_near(model: mujoco.MjModel, data: mujoco.MjData, pair: tuple[int, int]) -> bool:
    moving, other = pair
    if model.body_weldid[model.geom_bodyid[other]] != 0:
        return True
    point, extent = extent_from_still_point(model, data, moving)
    away = float(np.linalg.norm(data.geom_xpos[other] - point)) - float(model.geom_rbound[other])
    return away - extent < NEVER_NEAR


def _lowest(model: mujoco.MjModel, data: mujoco.MjData, geom: int) -> float:
    """Returns how near in m `geom` can come to the table, or less."""
    point, extent = extent_from_still_point(model, data, geom)
    return float(point[2]) - float(model.geom("table").pos[2]) - extent


def _meets_table(model: mujoco.MjModel, geom: int) -> bool:
    return bool(model.geom_contype[geom] | model.geom_conaffinity[geom])


def _enclosing_capsule(model: mujoco.MjModel, geom: int) -> tuple[np.ndarray, np.ndarray, float]:
    """Returns middle, half axis and radius of a capsule around `geom`, in its frame."""
    kind, size = int(model.geom_type[geom]), model.geom_size[geom]
    if kind == int(GEOM.mjGEOM_SPHERE):
        return np.zeros(3), np.zeros(3), float(size[0])
    if kind in (int(GEOM.mjGEOM_CAPSULE), int(GEOM.mjGEOM_CYLINDER)):
        return np.zeros(3), np.array([0.0, 0.0, size[1]]), float(size[0])
    center, half = model.geom_aabb[geom, :3], model.geom_aabb[geom, 3:]
    longest = int(np.argmax(half))
    others = np.delete(half, longest)
    half_axis = np.zeros(3)
    if kind == int(GEOM.mjGEOM_ELLIPSOID):
        # A ball of the middle radius at the end of this axis touches the tip from inside and holds the rest.
        half_axis[longest] = half[longest] - others.max()
        return center, half_axis, float(others.max())
    half_axis[longest] = half[longest]
    return center, half_axis, float(np.hypot(*others))


def _solids(model: mujoco.MjModel, data: mujoco.MjData, pairs: list[tuple[int, int]], row: dict[int, int]) -> Solids:
    geoms = np.array([b for _, b in pairs], dtype=np.int32)
    kinds = model.geom_type[geoms]
    is_exact = np.isin(kinds, (int(GEOM.mjGEOM_CYLINDER), int(GEOM.mjGEOM_ELLIPSOID)))[:, None]
    box = model.geom_aabb[geoms]
    rotation = data.geom_xmat[geoms].reshape(-1, 3, 3)
    center = np.where(is_exact, 0.0, box[:, :3])
    return Solids(
        capsule=jnp.asarray([row[a] for a, _ in pairs], jnp.int32),
        position=jnp.asarray(data.geom_xpos[geoms] + np.einsum("nij,nj->ni", rotation, center), jnp.float32),
        rotation=jnp.asarray(rotation, jnp.float32),
        size=jnp.asarray(np.where(is_exact, model.geom_size[geoms], box[:, 3:]), jnp.float32),
    )


def _can_touch(model: mujoco.MjModel, a: int, b: int) -> bool:
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
