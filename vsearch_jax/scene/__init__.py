"""Builds one MuJoCo model from a table, lights, a mount, an arm that hangs from the mount, an object and obstacles."""

from vsearch_jax.scene.assembly import Scene, build_scene
from vsearch_jax.scene.files import SceneError, available, xml_folder
from vsearch_jax.scene.joint_chain import joints_above

__all__ = ["Scene", "SceneError", "available", "build_scene", "joints_above", "xml_folder"]
