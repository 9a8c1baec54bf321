"""The joints between the world and a body."""

from __future__ import annotations

import mujoco


def joints_above(model: mujoco.MjModel, body: int) -> list[int]:
    """Returns MuJoCo's numbers of all joints that move a body, in order from the world to the body.

    Args:
      model: the compiled model.
      body: MuJoCo's number of the body.
    """
    joints: list[int] = []
    while body:
        first, count = int(model.body_jntadr[body]), int(model.body_jntnum[body])
        joints = [*range(first, first + count), *joints]
        body = int(model.body_parentid[body])
    return joints
