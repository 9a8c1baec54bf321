"""Contacts and table clearance of joint paths by C MuJoCo, sampled densely."""

import itertools

import mujoco
import numpy as np

from vsearch_jax.scene import Scene


class ContactOracle:
    """Checks configurations of a scene with C MuJoCo."""

    def __init__(self, scene: Scene) -> None:
        self.scene, self.model = scene, scene.mj_model
        self.data = mujoco.MjData(self.model)
        fixed = {g for g in range(self.model.ngeom) if self.model.body_weldid[self.model.geom_bodyid[g]] == 0}
        self.moving = [g for g in scene.arm_geom_ids if g not in fixed]

    def compute_contacts(self, qpos: np.ndarray) -> mujoco.MjData:
        """Returns MuJoCo's data with kinematics and contacts at `qpos`."""
        self.data.qpos[:] = qpos
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_comPos(self.model, self.data)
        mujoco.mj_camlight(self.model, self.data)
        mujoco.mj_collision(self.model, self.data)
        return self.data

    def is_free(self, qpos: np.ndarray) -> bool:
        """Returns whether nothing touches and the table's clearance is kept, up to rounding in float32."""
        data = self.compute_contacts(qpos)
        return data.ncon == 0 and self.table_distance() > self.scene.table_clearance - 1e-5

    def table_distance(self) -> float:
        """Returns the distance in m of the lowest point of the arm, whose moving geoms must all be capsules."""
        size, rotation = self.model.geom_size, self.data.geom_xmat.reshape(-1, 3, 3)
        lowest = [self.data.geom_xpos[g, 2] - abs(rotation[g, 2, 2]) * size[g, 1] - size[g, 0] for g in self.moving]
        return min(lowest) - self.scene.table_height

    def count_blocked(self, waypoints: np.ndarray, spacing: float = 0.01) -> int:
        """Returns how many samples of the path, `spacing` rad apart, are not free."""
        count = 0
        for start, end in itertools.pairwise(waypoints):
            steps = int(np.abs(end - start).max() / spacing) + 1
            if np.any(end != start):
                count += sum(not self.is_free(start + u * (end - start)) for u in np.linspace(0, 1, steps + 1))
        return count


def free_joints(scene: Scene, lower: np.ndarray, upper: np.ndarray, seed: int, count: int) -> np.ndarray:
    """Returns f32[count, nq], random free configurations between `lower` and `upper`."""
    oracle, random, found = ContactOracle(scene), np.random.default_rng(seed), []
    while len(found) < count:
        qpos = random.uniform(lower, upper).astype(np.float32)
        if oracle.is_free(qpos) and oracle.table_distance() > scene.table_clearance + 1e-4:
            found.append(qpos)
    return np.array(found)
