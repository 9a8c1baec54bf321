"""Poses of geoms, bodies and cameras: the only part of MuJoCo's data that the renderer reads."""

from __future__ import annotations

from typing import NamedTuple, Protocol

import jax.numpy as jnp
from jax import Array


class BodyPoses(Protocol):
    """Poses of bodies in the world frame. `mjx.Data`, `mujoco.MjData` and `Poses` have these fields."""

    @property
    def xpos(self) -> Array:
        """Positions of the nbody bodies' origins, f32[nbody, 3] m in world."""
        ...

    @property
    def xmat(self) -> Array:
        """Rotations of the nbody bodies, f32[nbody, 3, 3], body to world."""
        ...


class GeomPoses(BodyPoses, Protocol):
    """What `render` reads. The poses of bodies are read only if a body carries a light."""

    @property
    def geom_xpos(self) -> Array:
        """Positions of the ngeom geoms' origins, f32[ngeom, 3] m in world."""
        ...

    @property
    def geom_xmat(self) -> Array:
        """Rotations of the ngeom geoms, f32[ngeom, 3, 3], geom to world."""
        ...


class CameraPoses(Protocol):
    """What `camera` reads: poses of cameras in the world frame."""

    @property
    def cam_xpos(self) -> Array:
        """Positions of the ncam cameras, f32[ncam, 3] m in world."""
        ...

    @property
    def cam_xmat(self) -> Array:
        """Rotations of the ncam cameras, f32[ncam, 3, 3], camera to world."""
        ...


class PoseSource(GeomPoses, CameraPoses, Protocol):
    """All poses: a `mujoco.MjData` or an `mjx.Data`."""


class Poses(NamedTuple):
    """Poses of geoms, cameras and bodies in the world frame.

    Attributes:
      geom_xpos: f32[ngeom, 3] m.
      geom_xmat: f32[ngeom, 3, 3], geom to world.
      cam_xpos: f32[ncam, 3] m.
      cam_xmat: f32[ncam, 3, 3], camera to world.
      xpos: f32[nbody, 3] m.
      xmat: f32[nbody, 3, 3], body to world.
    """

    geom_xpos: Array
    geom_xmat: Array
    cam_xpos: Array
    cam_xmat: Array
    xpos: Array
    xmat: Array


def poses(data: PoseSource) -> Poses:
    """Copies the poses of geoms, bodies and cameras from MuJoCo's data into f32 arrays for the renderer.

    Args:
      data: a `mujoco.MjData` after `mj_forward`, or an `mjx.Data`. MJX computes geom and body poses in
        `mjx.kinematics`, and camera poses in `mjx.camlight`, which needs `mjx.com_pos` first.
    """

    def convert(position: Array, rotation: Array) -> tuple[Array, Array]:
        return jnp.asarray(position, jnp.float32), jnp.asarray(rotation, jnp.float32).reshape(-1, 3, 3)

    return Poses(
        *convert(data.geom_xpos, data.geom_xmat), *convert(data.cam_xpos, data.cam_xmat), *convert(data.xpos, data.xmat)
    )
