"""Mesh files as objects of a scene: formats, reading with colours, parts of one material, checks."""

from vsearch_jax.scene.meshes.checks import MeshError
from vsearch_jax.scene.meshes.formats import FORMAT_NAMES, MESH_SUFFIXES
from vsearch_jax.scene.meshes.object import load_mesh

__all__ = ["FORMAT_NAMES", "MESH_SUFFIXES", "MeshError", "load_mesh"]
