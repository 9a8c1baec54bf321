"""A batched ray caster for MuJoCo models in plain JAX: colour with shadows, depth, normals and geom ids."""

from vsearch_jax.render.cameras import camera, camera_from_matrix, camera_from_pose
from vsearch_jax.render.errors import RenderError
from vsearch_jax.render.image import render, render_batch, silhouette, supersample
from vsearch_jax.render.lights import Lights
from vsearch_jax.render.mj_poses import Poses, poses
from vsearch_jax.render.outline import Square, crop, soft_silhouette, square_around
from vsearch_jax.render.scene import RenderScene, compile_scene
from vsearch_jax.types import Camera, Image

__all__ = [
    "Camera",
    "Image",
    "Lights",
    "Poses",
    "RenderError",
    "RenderScene",
    "Square",
    "camera",
    "camera_from_matrix",
    "camera_from_pose",
    "compile_scene",
    "crop",
    "poses",
    "render",
    "render_batch",
    "silhouette",
    "soft_silhouette",
    "square_around",
    "supersample",
]
