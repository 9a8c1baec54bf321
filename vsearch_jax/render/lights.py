"""The lights of a model, and their poses relative to a camera.

MuJoCo gives the light of a body one of five modes (engine_core_smooth.c, `mj_camlight`): it is fixed to the body, it
keeps its direction and its offset from the body or from the centre of mass of the body's subtree (tracking), or it
turns towards another body or the centre of mass of that body's subtree (targeting). All follow from the poses of the
bodies.
"""

from __future__ import annotations

from typing import NamedTuple

import flax.struct
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array
from mujoco import mjtCamLight, mjtLightType

from vsearch_jax.render.errors import RenderError
from vsearch_jax.render.mj_poses import BodyPoses
from vsearch_jax.types import Camera

_FIXED, _TRACKING, _TARGETING = "fixed", "tracking", "targeting"
_MODES = {
    mjtCamLight.mjCAMLIGHT_FIXED: (_FIXED, False),
    mjtCamLight.mjCAMLIGHT_TRACK: (_TRACKING, False),
    mjtCamLight.mjCAMLIGHT_TRACKCOM: (_TRACKING, True),
    mjtCamLight.mjCAMLIGHT_TARGETBODY: (_TARGETING, False),
    mjtCamLight.mjCAMLIGHT_TARGETBODYCOM: (_TARGETING, True),
}
"""By MuJoCo's mode: how the light moves, and whether with the centre of mass of a subtree."""


@flax.struct.dataclass
class Lights:
    """The L active lights of a model with B bodies.

    Attributes:
      position: f32[L, 3] m, positions of the lights in the frame of the body that carries the light. For a light that
        tracks, the offset from the tracked point in world. Not used by directional lights.
      direction: f32[L, 3], unit vector along which the light shines, in the frame of that body. For a light that tracks
        in world. Not used by lights that turn to a target.
      ambient: f32[L, 3], light that does not depend on the angle of incidence.
      diffuse: f32[L, 3], light that falls off with the cosine of the angle of incidence.
      specular: f32[L, 3], light of the highlights.
      attenuation: f32[L, 3], constant, linear (1/m) and quadratic (1/m^2) term; not used by directional lights.
      cutoff: f32[L] rad, half angle of the cone of a spot light; pi for a point light.
      exponent: f32[L], power of the cosine with which a spot light decreases off its axis; 0 for a point light.
      center: f32[L, B, 4]. For a light that follows a centre of mass, the mass of each body of the subtree as a part of
        the subtree's mass, times the body's centre (x, y, z, 1) m in its own frame. Else 0. None without such lights.
      is_directional: for each light, whether its rays are parallel; static.
      is_shadowing: for each light, whether it casts shadows; static.
      bodies: for each light, id of the body that carries it, 0 for a light fixed in the world; static.
      modes: for each light "fixed", "tracking" or "targeting"; static.
      followed: for each light, id of the body that it tracks or turns to; -1 for none or for a centre of mass; static.
    """

    position: Array
    direction: Array
    ambient: Array
    diffuse: Array
    specular: Array
    attenuation: Array
    cutoff: Array
    exponent: Array
    center: Array | None
    is_directional: tuple[bool, ...] = flax.struct.field(pytree_node=False)
    is_shadowing: tuple[bool, ...] = flax.struct.field(pytree_node=False)
    bodies: tuple[int, ...] = flax.struct.field(pytree_node=False)
    modes: tuple[str, ...] = flax.struct.field(pytree_node=False)
    followed: tuple[int, ...] = flax.struct.field(pytree_node=False)


class LightPoses(NamedTuple):
    """Poses of the L lights of a scene in the camera's frame.

    Attributes:
      position: f32[L, 3] m, positions of the lights.
      direction: f32[L, 3], unit vectors along which the lights shine.
    """

    position: Array
    direction: Array


def light_poses(lights: Lights, data: BodyPoses, camera: Camera) -> LightPoses:
    """Returns the positions and directions of lights in the camera's frame.

    Args:
      lights: the lights of a scene.
      data: poses of the bodies in world. Only `xpos` and `xmat` are read, and only for lights that bodies move.
      camera: the camera in the world frame.
    """
    positions, directions = [], []
    for index, (body, mode) in enumerate(zip(lights.bodies, lights.modes, strict=True)):
        position, direction = lights.position[index], lights.direction[index]
        if mode == _TRACKING:
            position = _followed_point(lights, data, index) + position
        elif body:
            rotation = jnp.asarray(data.xmat[body], dtype=jnp.float32).reshape(3, 3)
            body_position = jnp.asarray(data.xpos[body], dtype=jnp.float32)
            position, direction = rotation @ position + body_position, rotation @ direction
        if mode == _TARGETING:
            offset = _followed_point(lights, data, index) - position
            direction = offset / jnp.sqrt(jnp.maximum(jnp.sum(offset * offset), 1e-20))
        positions.append(camera.rotation.T @ (position - camera.position))
        directions.append(camera.rotation.T @ direction)
    if not positions:
        return LightPoses(jnp.zeros((0, 3), jnp.float32), jnp.zeros((0, 3), jnp.float32))
    return LightPoses(jnp.stack(positions), jnp.stack(directions))


def _followed_point(lights: Lights, data: BodyPoses, index: int) -> Array:
    """Returns f32[3] m in world, the point that light `index` tracks or turns to."""
    xpos = jnp.asarray(data.xpos, dtype=jnp.float32)
    if lights.followed[index] >= 0:
        return xpos[lights.followed[index]]
    assert lights.center is not None
    xmat = jnp.asarray(data.xmat, dtype=jnp.float32).reshape(-1, 3, 3)
    center = lights.center[index]
    return jnp.einsum("bij,bj->i", xmat, center[:, :3]) + center[:, 3] @ xpos


def compile_lights(model: mujoco.MjModel) -> Lights:
    """Returns the active lights. A light on a body that cannot move counts as fixed in the world.

    Args:
      model: the compiled MuJoCo model.

    Raises:
      RenderError: an active light is an image light.
    """
    active = np.flatnonzero(model.light_active)
    for light in active:
        _check_light(model, int(light))
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    mujoco.mj_camlight(model, data)
    is_moving = _moving_bodies(model)
    motions = [_motion(model, data, is_moving, int(light)) for light in active]
    centers = [motion.center for motion in motions]
    is_point = model.light_type[active] == mjtLightType.mjLIGHT_POINT
    return Lights(
        position=_f32(np.array([motion.position for motion in motions]).reshape(-1, 3)),
        direction=_f32(np.array([motion.direction for motion in motions]).reshape(-1, 3)),
        ambient=_f32(model.light_ambient[active]),
        diffuse=_f32(model.light_diffuse[active]),
        specular=_f32(model.light_specular[active]),
        attenuation=_f32(model.light_attenuation[active]),
        cutoff=_f32(np.where(is_point, np.pi, np.deg2rad(model.light_cutoff[active]))),
        exponent=_f32(np.where(is_point, 0.0, model.light_exponent[active])),
        center=_f32(np.stack(centers)) if any(center.any() for center in centers) else None,
        is_directional=tuple(bool(t == mjtLightType.mjLIGHT_DIRECTIONAL) for t in model.light_type[active]),
        is_shadowing=tuple(bool(c) for c in model.light_castshadow[active]),
        bodies=tuple(motion.body for motion in motions),
        modes=tuple(motion.mode for motion in motions),
        followed=tuple(motion.followed for motion in motions),
    )


def _f32(values: np.ndarray | float) -> Array:
    return jnp.asarray(values, dtype=jnp.float32)


class _Motion(NamedTuple):
    """One light in `Lights.bodies`, `modes`, `followed`, `position`, `direction` and `center`."""

    body: int
    mode: str
    followed: int
    position: np.ndarray
    direction: np.ndarray
    center: np.ndarray


def _moving_bodies(model: mujoco.MjModel) -> np.ndarray:
    """Returns bool[B]: the body, or one above it, has a joint or is a mocap body."""
    is_moving = (model.body_jntnum > 0) | (model.body_mocapid >= 0)
    for body in range(1, model.nbody):
        is_moving[body] |= is_moving[model.body_parentid[body]]
    return is_moving


def _motion(model: mujoco.MjModel, data: mujoco.MjData, is_moving: np.ndarray, light: int) -> _Motion:
    """Returns how a light moves. `data` holds the poses of the initial state."""
    mode, is_center = _MODES[mjtCamLight(model.light_mode[light])]
    carrier, target = int(model.light_bodyid[light]), int(model.light_targetbodyid[light])
    followed = carrier if mode == _TRACKING else target
    none = np.zeros((model.nbody, 4))
    if mode == _TARGETING and target < 0:
        mode = _FIXED
    if mode == _TRACKING:
        offset = model.light_poscom0[light] if is_center else model.light_pos0[light]
        center = _center_of_mass(model, carrier) if is_center else none
        return _Motion(0, mode, -1 if is_center else followed, offset, model.light_dir0[light], center)
    body = carrier if is_moving[carrier] else 0
    position = model.light_pos[light] if body else data.light_xpos[light]
    direction = model.light_dir[light] if body else data.light_xdir[light]
    if mode == _FIXED:
        return _Motion(body, mode, -1, position, direction, none)
    center = _center_of_mass(model, target) if is_center else none
    return _Motion(body, mode, -1 if is_center else followed, position, direction, center)


def _center_of_mass(model: mujoco.MjModel, root: int) -> np.ndarray:
    """Returns f64[B, 4], a row of `Lights.center` for the subtree of the body `root`."""
    is_inside = np.zeros(model.nbody, bool)
    is_inside[root] = True
    for body in range(root + 1, model.nbody):
        is_inside[body] = is_inside[model.body_parentid[body]]
    mass = np.where(is_inside, model.body_mass, 0.0)
    if mass.sum() < mujoco.mjMINVAL:  # MuJoCo then takes the centre of the body itself
        mass = np.eye(model.nbody)[root]
    return (mass / mass.sum())[:, None] * np.concatenate([model.body_ipos, np.ones((model.nbody, 1))], axis=1)


def _check_light(model: mujoco.MjModel, light: int) -> None:
    if model.light_type[light] == mjtLightType.mjLIGHT_IMAGE:
        raise RenderError(
            f"light {model.light(light).name!r} (number {light}) is an image light, which cannot be rendered; use the "
            "type directional, spot or point"
        )
