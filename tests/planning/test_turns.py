"""A path leads to a full-turn equivalent of the goal where the goal itself cannot be reached."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from oracles.planning import ContactOracle
from vsearch_jax.config import PlanningConfig, SceneConfig
from vsearch_jax.planning import rrt_connect
from vsearch_jax.robot import build_arm
from vsearch_jax.scene import build_scene
from vsearch_jax.types import PlanStatus

# A beam that turns about the vertical, and a post at azimuth 0.
ARM = """
<mujoco>
  <worldbody>
    <body name="beam" pos="0 0 0.1">
      <joint axis="0 0 1" range="{low} {high}"/>
      <geom type="capsule" size="0.02" fromto="0.1 0 0 0.5 0 0"/>
      <site name="tcp" pos="0.5 0 0"/>
      <camera name="wrist" pos="0.5 0 0"/>
    </body>
  </worldbody>
</mujoco>
"""
POST = '<mujoco><worldbody><geom type="capsule" size="0.02" fromto="0.4 0 0.7 0.4 0 1.1"/></worldbody></mujoco>'


@pytest.mark.parametrize(("limit", "status"), [(360, PlanStatus.FOUND), (170, PlanStatus.EXHAUSTED)])
def test_a_beam_turns_the_other_way_round(tmp_path, limit, status):
    (tmp_path / "arm.xml").write_text(ARM.format(low=-limit, high=limit))
    (tmp_path / "post.xml").write_text(POST)
    scene = build_scene(
        SceneConfig(arm=str(tmp_path / "arm.xml"), obstacles=str(tmp_path / "post.xml"), mount_height=1.0)
    )
    arm, config = build_arm(scene), PlanningConfig(num_nodes=16, max_iterations=32)
    start, goal = jnp.array([0.4]), jnp.array([-0.4])
    path = jax.jit(lambda arm: rrt_connect(arm, jax.random.key(0), start, goal, config))(arm)
    assert int(path.status) == status
    if status == PlanStatus.FOUND:
        end = float(path.waypoints[-1, 0])
        assert end == pytest.approx(2 * np.pi - 0.4, abs=1e-5)
        assert ContactOracle(scene).count_blocked(np.asarray(path.waypoints, float)) == 0
