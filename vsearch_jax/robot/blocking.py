"""Names the pairs of geoms that touch in every configuration, which leave an arm no free one."""

from __future__ import annotations

import mujoco
import numpy as np

from vsearch_jax.robot.collision.candidates import NUM_CONFIGURATIONS, random_configurations
from vsearch_jax.robot.collision.solids import convex_solid
from vsearch_jax.scene import Scene
from vsearch_jax.scene.assembly import ARM_PREFIX

MAX_NAMED = 4
"""Pairs that a message names."""


def describe_blocking_contacts(scene: Scene) -> str:
    """Describes the contacts that an arm has in every configuration, with the remedy for each.

    C MuJoCo computes the contacts of random configurations inside the joint limits.

    Args:
      scene: the scene.

    Returns:
      Text to append to an error message, with a leading "; ". Empty if no pair touches in all configurations.
    """
    lowest = _always_touching(scene)
    if not lowest:
        return ""
    texts = [_describe_pair(scene, pair, lowest[pair]) for pair in sorted(lowest)[:MAX_NAMED]]
    more = f"; and {len(lowest) - MAX_NAMED} more pairs" if len(lowest) > MAX_NAMED else ""
    return f"; these geoms touch in all of {NUM_CONFIGURATIONS} random configurations: {'; '.join(texts)}{more}"


def _always_touching(scene: Scene) -> dict[tuple[int, int], float]:
    """Returns the pairs, a geom of the arm first, that touch in every configuration.

    The value is how far in m the first geom reaches below the plane of the arm's base, at least.
    """
    model, arm_geoms = scene.mj_model, set(scene.arm_geom_ids)
    found: dict[tuple[int, int], float] | None = None
    for data in random_configurations(model):
        mujoco.mj_comPos(model, data)
        mujoco.mj_collision(model, data)
        pairs = {(int(c.geom1), int(c.geom2)) for c in data.contact if c.dist <= 0.0}
        touching = {(a, b) if a in arm_geoms else (b, a) for a, b in pairs if arm_geoms & {a, b}}
        kept = touching if found is None else touching & found.keys()
        depths = {pair: _depth_below_base(scene, data, pair[0]) for pair in kept}
        found = {pair: min(depth, found[pair]) if found else depth for pair, depth in depths.items()}
        if not found:
            break
    return found or {}


def _depth_below_base(scene: Scene, data: mujoco.MjData, geom: int) -> float:
    """Returns how far in m a geom reaches below the plane of the arm's base, towards the mount."""
    model, mount = scene.mj_model, scene.mj_model.body("mount").id
    up = -data.xmat[mount].reshape(3, 3)[:, 2]  # The +z axis of the mount points from the base into the arm.
    solid, rotation = convex_solid(model, geom), data.geom_xmat[geom].reshape(3, 3)
    direction = rotation.T @ up
    reach = (solid.points @ direction).max() + np.linalg.norm(solid.radii * direction) + solid.ball
    return float((data.geom_xpos[geom] - data.xpos[mount]) @ up + reach)


def _describe_pair(scene: Scene, pair: tuple[int, int], depth: float) -> str:
    model, (geom, other) = scene.mj_model, pair
    body, other_body = (_name(model.body(int(model.geom_bodyid[g])).name) for g in pair)
    text = f"{_geom_name(model, geom)} of body {body!r} and {_geom_name(model, other)}"
    if other in scene.mount_geom_ids:
        return (
            f"{text} of the scene's mount, which an arm's file cannot exclude: raise the base by at least "
            f"{max(depth, 0.0) + 0.005:.3f} m, by the `pos` of the arm's first body"
        )
    if other in scene.arm_geom_ids:
        exclude = f'<contact><exclude body1="{body}" body2="{other_body}"/></contact>'
        hint = "" if body and other_body else " after you name both bodies"
        return f"{text} of body {other_body!r}: if they may touch, add {exclude} to the arm's file{hint}"
    return f"{text} of the scene: raise the mount (SceneConfig.mount_height), or move that geom"


def _geom_name(model: mujoco.MjModel, geom: int) -> str:
    name = _name(model.geom(geom).name)
    return f"geom {name!r}" if name else f"geom number {geom}"


def _name(name: str) -> str:
    """Returns an element's name in the arm's own file."""
    return name.removeprefix(ARM_PREFIX)
