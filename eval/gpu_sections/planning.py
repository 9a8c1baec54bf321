"""Inverse kinematics and RRT-Connect per second against batch size and number of lanes."""

from __future__ import annotations

from collections.abc import Iterator

import jax
import numpy as np

from gpu_sections.measure import Row, Settings, measure, sweep
from vsearch_jax.config import IKConfig, PlanningConfig, SceneConfig
from vsearch_jax.planning import ik, lane_counts, rrt_connect
from vsearch_jax.robot import Arm, build_arm, camera_pose, forward_kinematics, is_free
from vsearch_jax.scene import build_scene


def run(settings: Settings) -> Iterator[Row]:
    """Yields rows of IK, then of RRT-Connect among posts, each also with other numbers of lanes.

    A quick run has one row of each, the second with another number of lanes.
    """
    is_quick = settings.is_quick
    arm = build_arm(build_scene(SceneConfig()))
    batches = [16] if is_quick else [64, 1024, 16384]
    yield from sweep(batches, lambda batch: _ik(arm, batch, settings))
    cluttered = build_arm(build_scene(SceneConfig(obstacles="posts")))
    rrt_batches = [8] if is_quick else [64, 512, 4096]
    if not is_quick:
        yield from sweep(rrt_batches, lambda batch: _rrt(cluttered, batch, settings))
    for num_lanes in [4] if is_quick else [64, 512, 4096]:
        with lane_counts.override(rrt=num_lanes):
            yield {"lanes": num_lanes} | _rrt(cluttered, rrt_batches[-1], settings)
    for num_lanes in [] if is_quick else [256, 16384]:
        with lane_counts.override(ik=num_lanes):
            yield {"lanes": num_lanes} | _ik(arm, batches[-1], settings)


def random_configurations(arm: Arm, seed: int, count: int) -> np.ndarray:
    """Returns f32[count, nq] inside the limits; joints that do not move the camera are at home."""
    joints = np.random.default_rng(seed).uniform(arm.lower, arm.upper, (count, len(arm.lower))).astype(np.float32)
    others = np.setdiff1d(np.arange(joints.shape[1]), arm.chain.address)
    joints[:, others] = np.asarray(arm.home)[others]
    return joints


def _ik(arm: Arm, batch: int, settings: Settings) -> Row:
    config = IKConfig()
    wanted, present = random_configurations(arm, 1, batch), random_configurations(arm, 2, batch)
    poses = jax.jit(jax.vmap(lambda q: camera_pose(arm, forward_kinematics(arm, q))))(wanted)
    return measure("IK", batch, settings, jax.vmap(lambda pose, q: ik(arm, pose, q, config)), poses, present)


def _rrt(arm: Arm, batch: int, settings: Settings) -> Row:
    config = PlanningConfig()
    joints = random_configurations(arm, 5, 16 * batch)
    is_clear = jax.jit(jax.vmap(lambda q: is_free(arm, forward_kinematics(arm, q))))(joints)
    joints = joints[np.asarray(is_clear)]
    start, goal = np.resize(joints[::2], (batch, joints.shape[1])), np.resize(joints[1::2], (batch, joints.shape[1]))
    keys = jax.random.split(jax.random.key(0), batch)
    plan = jax.vmap(lambda key, a, b: rrt_connect(arm, key, a, b, config))
    return measure("RRT-Connect, posts", batch, settings, plan, keys, start, goal)
