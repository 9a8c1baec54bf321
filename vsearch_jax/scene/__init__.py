"""Builds one MuJoCo model from a table, lights, a mount, an arm that hangs from the mount, an object and obstacles."""

from vsearch_jax.scene.assembly import Scene, build_scene, object_symmetry
from vsearch_jax.scene.files import SceneError, available, xml_folder
from vsearch_jax.scene.fingerprint import Fingerprint, check_unchanged, scene_fingerprint
from vsearch_jax.scene.joint_chain import joints_above
from vsearch_jax.scene.surface import box_corners, describe_symmetry

__all__ = [
    "Fingerprint",
    "Scene",
    "SceneError",
    "available",
    "box_corners",
    "build_scene",
    "check_unchanged",
    "describe_symmetry",
    "joints_above",
    "object_symmetry",
    "scene_fingerprint",
    "xml_folder",
]
