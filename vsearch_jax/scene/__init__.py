"""One MuJoCo model out of table, lights, mount, an arm that hangs from the mount, and an object to look at."""

from vsearch_jax.scene.assembly import Scene, build_scene
from vsearch_jax.scene.files import SceneError, available, xml_folder
from vsearch_jax.scene.joint_chain import joints_above

__all__ = ["Scene", "SceneError", "available", "build_scene", "joints_above", "xml_folder"]
