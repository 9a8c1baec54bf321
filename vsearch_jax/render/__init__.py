"""A batched ray-caster for MuJoCo models in plain JAX: colour with cast shadows, depth and geom numbers."""

from vsearch_jax.render.camera import camera, camera_from_pose
from vsearch_jax.render.image import render, silhouette
from vsearch_jax.render.scene import Lights, RenderError, RenderScene, compile_scene

__all__ = [
    "Lights",
    "RenderError",
    "RenderScene",
    "camera",
    "camera_from_pose",
    "compile_scene",
    "render",
    "silhouette",
]
