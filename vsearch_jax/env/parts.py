"""What the task is built from: scene, arm and renderer's scene, with all checks that need no long computation."""

from __future__ import annotations

from typing import NamedTuple

import jax

from vsearch_jax import render
from vsearch_jax.config import Config, ConfigError
from vsearch_jax.planning.drive import check_drive
from vsearch_jax.robot.arm import Arm, build_arm
from vsearch_jax.scene import Scene, SceneError, build_scene

_REFUSED_SETTINGS = {
    "jax_enable_x64": "vsearch_jax computes in 32 bits",
    "jax_debug_nans": "NaN stands for values that do not exist, such as the metrics of another stage",
    "jax_debug_infs": "infinity stands for values that do not exist, such as the depth of a ray that hits nothing",
}
"""Settings of JAX with which the task does not run, and the reason."""


class TaskParts(NamedTuple):
    """Parts of the task that come from files.

    Attributes:
      scene: the built scene.
      arm: the arm in it.
      render_scene: the scene as the renderer reads it.
    """

    scene: Scene
    arm: Arm
    render_scene: render.RenderScene


def check_jax_settings() -> None:
    """Checks that no setting of JAX is on with which the task does not run.

    Raises:
      ConfigError: 64-bit numbers, or the search for NaN or infinity, are switched on.
    """
    for name, reason in _REFUSED_SETTINGS.items():
        if jax.config.values[name]:
            raise ConfigError(f"the setting {name.upper()} of JAX is on, but {reason}; switch it off: {name.upper()}=0")


def build_parts(config: Config) -> TaskParts:
    """Loads the scene and checks that the arm can be planned for and that the renderer can draw the scene.

    Args:
      config: the run's config; `scene` and `env.motion` are read.

    Raises:
      ConfigError: a setting of JAX is on with which the task does not run.
      SceneError: arm or object cannot be loaded, no geom of the object is visible, or `config.env.motion` is "dynamic"
        and a joint has no position actuator.
      RenderError: the renderer cannot draw an element of the scene.
      PlanningError: `config.env.motion` is "dynamic" and a joint has no speed limit.
    """
    check_jax_settings()
    scene = build_scene(config.scene)
    arm = build_arm(scene)
    if config.env.motion == "dynamic":
        check_drive(scene, arm)
    render_scene = render.compile_scene(scene.mj_model)
    if not set(scene.object_geom_ids) & set(render_scene.geom_ids):
        raise SceneError(
            f"object {config.scene.object!r} has no visible geom in the groups 0 to 2; the renderer draws only these "
            "groups, so put a geom of the object into one of them"
        )
    return TaskParts(scene, arm, render_scene)
