"""The part of MuJoCo's data that the renderer reads."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import Array


class Poses(NamedTuple):
    """Where geoms, cameras and bodies are, all in world; rotations take their frames to world.

    Attributes:
      geom_xpos: f32[ngeom, 3] m.
      geom_xmat: f32[ngeom, 3, 3].
      cam_xpos: f32[ncam, 3] m.
      cam_xmat: f32[ncam, 3, 3].
      xpos: f32[nbody, 3] m.
      xmat: f32[nbody, 3, 3].
    """

    geom_xpos: Array
    geom_xmat: Array
    cam_xpos: Array
    cam_xmat: Array
    xpos: Array
    xmat: Array


def poses(data: Any) -> Poses:
    """Returns the poses of `data`, a mujoco.MjData after mj_forward or an mjx.Data.

    MJX fills the poses of geoms in `mjx.kinematics`, those of cameras in `mjx.camlight`, after `mjx.com_pos`.
    """

    def read(position: Any, rotation: Any) -> tuple[Array, Array]:
        return jnp.asarray(position, jnp.float32), jnp.asarray(rotation, jnp.float32).reshape(-1, 3, 3)

    return Poses(
        *read(data.geom_xpos, data.geom_xmat), *read(data.cam_xpos, data.cam_xmat), *read(data.xpos, data.xmat)
    )
