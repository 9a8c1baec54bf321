"""Signed distances between the arm's capsules and what they must not touch.

Two capsules have a closed form (Ericson, Real-Time Collision Detection, 5.1.9). From a capsule to another convex solid
the distance is that of the solid, minimised over the capsule's axis; it is convex there, so a golden section finds it.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable

import flax.struct
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array

from vsearch_jax.kinematics import rotate

GEOM = mujoco.mjtGeom
GOLDEN = (math.sqrt(5.0) - 1.0) / 2.0
# 0.618^14 = 1e-3 of the axis; near its minimum the distance changes by far less. The ends are looked at too.
SEARCH_ITERATIONS = 14
# Newton's steps from the left of a convex sum converge quadratically, and what is left shortens the distance.
NEWTON_ITERATIONS = 4


@flax.struct.dataclass
class Solids:
    """Pairs of a capsule and a solid; N pairs.

    Attributes:
      capsule: i32[N], row of `Pairs.geom`.
      geom: i32[N], the solid's geom.
      center: f32[N, 3] m, the solid's middle in the geom's frame.
      size: f32[N, 3] m: half sizes of a box, radii of an ellipsoid, radius and half length of a cylinder.
      is_cylinder: bool[N].
      is_object: bool[N], the solid belongs to the object; else to the mount.
    """

    capsule: Array
    geom: Array
    center: Array
    size: Array
    is_cylinder: Array
    is_object: Array


@flax.struct.dataclass
class Pairs:
    """What must not touch; C capsules, the arm's first, then spheres and capsules of mount and object.

    Attributes:
      geom: i32[C], the geom of each capsule.
      center: f32[C, 3] m, the capsule's middle in the geom's frame.
      half_axis: f32[C, 3] m, from the middle to one end of the axis, in the geom's frame.
      radius: f32[C] m.
      table: i32[M], capsules that must stay above the table.
      first: i32[P], one of each pair of capsules.
      second: i32[P], the other one.
      is_object: bool[P], `second` belongs to the object.
      blocks: capsules against boxes and cylinders.
      ellipsoids: capsules against ellipsoids.
    """

    geom: Array
    center: Array
    half_axis: Array
    radius: Array
    table: Array
    first: Array
    second: Array
    is_object: Array
    blocks: Solids
    ellipsoids: Solids


def build_pairs(
    model: mujoco.MjModel, arm_geoms: tuple[int, ...], mount_geoms: tuple[int, ...], object_geoms: tuple[int, ...]
) -> Pairs:
    """Lists the pairs that can touch, by MuJoCo's rules: contact bits, weld groups, neighbours and excluded bodies.

    Args:
      model: the compiled scene.
      arm_geoms: geoms of the arm.
      mount_geoms: geoms of the mount.
      object_geoms: geoms of the object.
    """
    moving = [g for g in arm_geoms if model.body_weldid[model.geom_bodyid[g]] != 0]
    round_kinds = (int(GEOM.mjGEOM_SPHERE), int(GEOM.mjGEOM_CAPSULE))
    others = [*mount_geoms, *object_geoms]
    capsules = [*arm_geoms, *(g for g in others if int(model.geom_type[g]) in round_kinds)]
    row = {g: i for i, g in enumerate(capsules)}
    shapes = [_enclosing_capsule(model, g) for g in capsules]
    round_pairs: list[tuple[int, int]] = []
    solid_pairs: list[tuple[int, int]] = []
    static = [g for g in arm_geoms if g not in moving]
    for i, a in enumerate(moving):
        for b in [*static, *moving[i + 1 :], *others]:
            if _can_touch(model, a, b):
                (round_pairs if b in row else solid_pairs).append((a, b))
    is_ellipsoid = [int(model.geom_type[b]) == int(GEOM.mjGEOM_ELLIPSOID) for _, b in solid_pairs]
    blocks = [pair for pair, is_smooth in zip(solid_pairs, is_ellipsoid, strict=True) if not is_smooth]
    ellipsoids = [pair for pair, is_smooth in zip(solid_pairs, is_ellipsoid, strict=True) if is_smooth]
    bits = model.geom_contype | model.geom_conaffinity
    return Pairs(
        geom=jnp.asarray(capsules, jnp.int32),
        center=jnp.asarray([s[0] for s in shapes], jnp.float32),
        half_axis=jnp.asarray([s[1] for s in shapes], jnp.float32),
        radius=jnp.asarray([s[2] for s in shapes], jnp.float32),
        table=jnp.asarray([row[g] for g in moving if bits[g]], jnp.int32),
        first=jnp.asarray([row[a] for a, _ in round_pairs], jnp.int32),
        second=jnp.asarray([row[b] for _, b in round_pairs], jnp.int32),
        is_object=jnp.asarray([b in object_geoms for _, b in round_pairs], bool),
        blocks=_solids(model, blocks, row, object_geoms),
        ellipsoids=_solids(model, ellipsoids, row, object_geoms),
    )


def distances(pairs: Pairs, geom_xpos: Array, geom_xmat: Array, table_height: Array) -> tuple[Array, Array, Array]:
    """Returns the signed distances f32[] in m from table, from object, and within the arm and from its mount.

    Args:
      pairs: what must not touch.
      geom_xpos: f32[ngeom, 3] m in world.
      geom_xmat: f32[ngeom, 3, 3] to world.
      table_height: f32[] m, world z.
    """
    rotation = geom_xmat[pairs.geom]
    center = geom_xpos[pairs.geom] + rotate(rotation, pairs.center)
    half_axis = rotate(rotation, pairs.half_axis)
    lowest = center[:, 2] - jnp.abs(half_axis[:, 2]) - pairs.radius
    table = jnp.min(lowest[pairs.table] - table_height, initial=jnp.inf)
    first, second = pairs.first, pairs.second
    gap = jax.vmap(segment_distance)(center[first], half_axis[first], center[second], half_axis[second])
    round_gap = gap - pairs.radius[first] - pairs.radius[second]
    solids = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), pairs.blocks, pairs.ellipsoids)
    rotation = geom_xmat[solids.geom]
    local = _rotate_back(rotation, center[solids.capsule] - geom_xpos[solids.geom]) - solids.center
    axis = _rotate_back(rotation, half_axis[solids.capsule])
    solid_gap = _nearest_on_axis(solids, pairs.blocks.geom.shape[0], local, axis) - pairs.radius[solids.capsule]
    gaps = jnp.concatenate([round_gap, solid_gap])
    is_object = jnp.concatenate([pairs.is_object, solids.is_object])
    target = jnp.min(jnp.where(is_object, gaps, jnp.inf), initial=jnp.inf)
    own = jnp.min(jnp.where(is_object, jnp.inf, gaps), initial=jnp.inf)
    return table, target, own


def segment_distance(center_a: Array, half_a: Array, center_b: Array, half_b: Array) -> Array:
    """Returns the distance f32[] in m of two segments, each given by its middle and half of itself (f32[3] m).

    A segment may be a point; parallel segments are no exception (Ericson 5.1.9).
    """
    tiny = 1e-12
    offset = center_a - center_b
    aa, bb, ab = jnp.dot(half_a, half_a), jnp.dot(half_b, half_b), jnp.dot(half_a, half_b)
    oa, ob = jnp.dot(half_a, offset), jnp.dot(half_b, offset)
    determinant = aa * bb - ab * ab
    is_skew = determinant > 1e-6 * aa * bb
    s = jnp.where(is_skew, (ab * ob - bb * oa) / jnp.where(is_skew, determinant, 1.0), 0.0)
    s = jnp.clip(s, -1.0, 1.0)
    t = jnp.clip((ab * s + ob) / jnp.maximum(bb, tiny), -1.0, 1.0)
    s = jnp.clip((ab * t - oa) / jnp.maximum(aa, tiny), -1.0, 1.0)
    t = jnp.clip((ab * s + ob) / jnp.maximum(bb, tiny), -1.0, 1.0)
    gap = offset + s * half_a - t * half_b
    return jnp.sqrt(jnp.maximum(jnp.dot(gap, gap), 1e-24))


def block_distance(point: Array, size: Array, is_cylinder: Array) -> Array:
    """Returns the signed distance f32[] in m of a point from a box or a cylinder.

    Args:
      point: f32[3] m in the solid's frame.
      size: f32[3] m: half sizes of a box; radius and half length of a cylinder about z.
      is_cylinder: bool[].
    """
    box = jnp.abs(point) - size
    # A cylinder is a rectangle in the half plane of the point; its third face is too deep to matter.
    cylinder = jnp.stack([_norm(point[:2]) - size[0], jnp.abs(point[2]) - size[1], -jnp.inf])
    outside = jnp.where(is_cylinder, cylinder, box)
    return _norm(jnp.maximum(outside, 0.0)) + jnp.minimum(jnp.max(outside), 0.0)


def ellipsoid_distance(point: Array, size: Array) -> Array:
    """Returns the signed distance f32[] in m of `point` (f32[3]) from an ellipsoid of radii `size` (f32[3]).

    The foot of the perpendicular is r^2 p / (t + r^2) with t the largest root of sum (r p / (t + r^2))^2 = 1 (Eberly,
    Distance from a Point to an Ellipsoid). The sum is convex and falls, so Newton's steps from the left stay left.
    """
    p = jnp.maximum(jnp.abs(point), 1e-7)  # keeps the foot unique at the centre and in the planes of symmetry
    squared = size * size
    t = jnp.max(size * p - squared)
    for _ in range(NEWTON_ITERATIONS):
        ratio = size * p / (t + squared)
        value = jnp.sum(ratio * ratio) - 1.0
        slope = -2.0 * jnp.sum(ratio * ratio / (t + squared))
        t = t - value / slope
    foot = squared * p / (t + squared)
    return jnp.sign(t) * _norm(p - foot)


def _nearest_on_axis(solids: Solids, num_blocks: int, center: Array, half_axis: Array) -> Array:
    """Golden section over the axes, f32[N, 3] in the solids' frames; returns the least distances seen, f32[N]."""
    at = functools.partial(_distances_on_axis, solids, num_blocks, center, half_axis)
    low = jnp.full(center.shape[0], -1.0)
    high = -low
    state = (
        low,
        high,
        at(high - GOLDEN * (high - low)),
        at(low + GOLDEN * (high - low)),
        jnp.minimum(at(low), at(high)),
    )
    *_, f_low, f_high, f_ends = jax.lax.fori_loop(0, SEARCH_ITERATIONS, functools.partial(_narrow, at), state)
    return jnp.minimum(jnp.minimum(f_low, f_high), f_ends)


def _distances_on_axis(solids: Solids, num_blocks: int, center: Array, half_axis: Array, s: Array) -> Array:
    points = center + s[:, None] * half_axis
    blocks = jax.vmap(block_distance)(points[:num_blocks], solids.size[:num_blocks], solids.is_cylinder[:num_blocks])
    ellipsoids = jax.vmap(ellipsoid_distance)(points[num_blocks:], solids.size[num_blocks:])
    return jnp.concatenate([blocks, ellipsoids])


def _narrow(at: Callable[[Array], Array], _: int, state: tuple[Array, ...]) -> tuple[Array, ...]:
    low, high, f_low, f_high, f_ends = state  # f at low + (1 - GOLDEN) width and at low + GOLDEN width
    is_left = f_low < f_high
    width = high - low
    low, high = jnp.where(is_left, low, high - GOLDEN * width), jnp.where(is_left, low + GOLDEN * width, high)
    width = high - low
    f_new = at(jnp.where(is_left, high - GOLDEN * width, low + GOLDEN * width))
    return low, high, jnp.where(is_left, f_new, f_high), jnp.where(is_left, f_low, f_new), f_ends


def _norm(vector: Array) -> Array:
    return jnp.sqrt(jnp.maximum(jnp.sum(vector * vector, axis=-1), 1e-24))


def _rotate_back(rotation: Array, vector: Array) -> Array:
    return jnp.sum(rotation * vector[..., :, None], axis=-2)


def _enclosing_capsule(model: mujoco.MjModel, geom: int) -> tuple[np.ndarray, np.ndarray, float]:
    """Returns middle, half axis and radius of a capsule around `geom`, in its frame."""
    kind, size = int(model.geom_type[geom]), model.geom_size[geom]
    if kind == int(GEOM.mjGEOM_SPHERE):
        return np.zeros(3), np.zeros(3), float(size[0])
    if kind in (int(GEOM.mjGEOM_CAPSULE), int(GEOM.mjGEOM_CYLINDER)):
        return np.zeros(3), np.array([0.0, 0.0, size[1]]), float(size[0])
    center, half = model.geom_aabb[geom, :3], model.geom_aabb[geom, 3:]
    longest = int(np.argmax(half))
    half_axis = np.zeros(3)
    half_axis[longest] = half[longest]
    return center, half_axis, float(np.hypot(*np.delete(half, longest)))


def _solids(
    model: mujoco.MjModel, pairs: list[tuple[int, int]], row: dict[int, int], object_geoms: tuple[int, ...]
) -> Solids:
    geoms = np.array([b for _, b in pairs], dtype=np.int32)
    kinds = model.geom_type[geoms]
    is_exact = np.isin(kinds, (int(GEOM.mjGEOM_CYLINDER), int(GEOM.mjGEOM_ELLIPSOID)))[:, None]
    box = model.geom_aabb[geoms]
    return Solids(
        capsule=jnp.asarray([row[a] for a, _ in pairs], jnp.int32),
        geom=jnp.asarray(geoms),
        center=jnp.asarray(np.where(is_exact, 0.0, box[:, :3]), jnp.float32),
        size=jnp.asarray(np.where(is_exact, model.geom_size[geoms], box[:, 3:]), jnp.float32),
        is_cylinder=jnp.asarray(kinds == int(GEOM.mjGEOM_CYLINDER)),
        is_object=jnp.asarray(np.isin(geoms, object_geoms)),
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
