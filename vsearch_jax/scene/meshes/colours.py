"""Colours and textures of the triangles of a mesh, as trimesh reads them from a file."""

from __future__ import annotations

import re
from typing import NamedTuple

import numpy as np
import trimesh
from PIL.Image import Image
from trimesh.visual.color import to_rgba
from trimesh.visual.material import Material, PBRMaterial, SimpleMaterial, empty_material
from trimesh.visual.texture import TextureVisuals

_OPAQUE, _WHITE = 255, (255, 255, 255, 255)
# Attributes of a PBR material that MuJoCo's renderer has no counterpart of, in words.
_PBR_EXTRAS = {
    "normalTexture": "normal maps",
    "occlusionTexture": "occlusion maps",
    "metallicRoughnessTexture": "metallic-roughness maps",
    "emissiveTexture": "emission",
}


class Colours(NamedTuple):
    """Colours of F triangles. All are None if the file gives no colour.

    Attributes:
      corners: f32[F, 3, 3] in [0, 1], red, green and blue at the three corners of each triangle; or None.
      image: u8[H, W, 4], the texture with alpha, top row first; or None. The colours of the corners multiply it.
      texcoords: f64[F, 3, 2], texture coordinates of the corners, v upwards from the bottom row; None without texture.
      losses: what cannot be drawn, in words.
    """

    corners: np.ndarray | None
    image: np.ndarray | None
    texcoords: np.ndarray | None
    losses: list[str]


class Images:
    """The textures of a file. Each is converted once, and equal ones are one array."""

    def __init__(self) -> None:
        self._of_picture: dict[int, np.ndarray | None] = {}
        self._of_content: dict[tuple[tuple[int, ...], bytes], np.ndarray] = {}

    def rgba(self, picture: Image) -> np.ndarray | None:
        """Returns u8[H, W, 4], the texels of a picture, top row first; None if the picture is damaged.

        Args:
          picture: a picture that lives as long as this object.
        """
        if id(picture) not in self._of_picture:
            self._of_picture[id(picture)] = self._convert(picture)
        return self._of_picture[id(picture)]

    def _convert(self, picture: Image) -> np.ndarray | None:
        try:
            rgba = np.asarray(picture.convert("RGBA"))
        except (OSError, SyntaxError, ValueError):  # Pillow reads the texels only now.
            return None
        return self._of_content.setdefault((rgba.shape, rgba.tobytes()), rgba)


def colours_of(mesh: trimesh.Trimesh, images: Images) -> Colours:
    """Returns the colours of a mesh as trimesh has them.

    A texture wins over the diffuse colour of an OBJ's material. The base colour of glTF multiplies texture and vertex
    colours. Colours are used as the file has them: linear and sRGB values are not converted.

    Args:
      mesh: a mesh of F triangles that trimesh has read.
      images: the textures of the file; shared by its meshes.
    """
    visual, faces = mesh.visual, mesh.faces
    if isinstance(visual, TextureVisuals):
        return _material_colours(visual, faces, images)
    if visual is None or visual.kind is None:
        return Colours(None, None, None, [])
    rgba = visual.face_colors[:, None].repeat(3, axis=1) if visual.kind == "face" else visual.vertex_colors[faces]
    return Colours(_rgb(rgba), None, None, _transparency(rgba))


def _material_colours(visual: TextureVisuals, faces: np.ndarray, images: Images) -> Colours:
    material = visual.material
    factor = _factor(material)
    painted = visual.vertex_attributes.get("color")
    losses = _material_losses(material)
    image, image_losses = _texture(material, images)
    losses += image_losses
    if image is not None and visual.uv is None:
        image, losses = None, [*losses, "textures without texture coordinates"]
    if painted is not None:
        corners = to_rgba(painted)[faces] * (factor / _OPAQUE)
        losses += _transparency(corners)
        if image is not None and np.any(corners != corners[:1, :1]):
            corners, losses = np.broadcast_to(factor, corners.shape), [*losses, "vertex colours of textured triangles"]
    elif image is None and _is_placeholder(material):
        return Colours(None, None, None, losses)
    else:
        corners = np.broadcast_to(factor, (len(faces), 3, 4))
    texcoords = None if image is None else np.asarray(visual.uv, np.float64)[faces][..., :2]
    return Colours(_rgb(corners), image, texcoords, losses)


def _factor(material: Material) -> np.ndarray:
    """Returns f64[4] in [0, 255], the colour of a material with alpha."""
    if isinstance(material, PBRMaterial):
        colour = material.baseColorFactor  # None is white in glTF, but grey in trimesh's `main_color`.
    else:
        is_textured = isinstance(material, SimpleMaterial) and material.image is not None
        colour = None if is_textured else material.main_color
    return np.array(_WHITE if colour is None else colour, np.float64)


def _is_placeholder(material: Material) -> bool:
    """Returns whether trimesh made the material itself, because the file has texture coordinates but no material."""
    if not isinstance(material, SimpleMaterial) or material.image is None or "kd" in material.kwargs:
        return False
    default = empty_material().image
    assert default is not None
    return material.image.size == default.size and material.image.tobytes() == default.tobytes()


def _texture(material: Material, images: Images) -> tuple[np.ndarray | None, list[str]]:
    """Returns the texture u8[H, W, 4] of a material, or None; and what cannot be drawn of it."""
    is_pbr = isinstance(material, PBRMaterial)
    picture = material.baseColorTexture if is_pbr else getattr(material, "image", None)
    if picture is None or _is_placeholder(material):
        return None, []
    rgba = images.rgba(picture)
    if rgba is None:
        return None, ["textures whose image is damaged"]
    is_opaque = is_pbr and material.alphaMode in (None, "OPAQUE")
    return rgba, [] if is_opaque else _transparency(rgba)


def _material_losses(material: Material) -> list[str]:
    """Lists what cannot be drawn of a material, apart from its texture."""
    if isinstance(material, SimpleMaterial):
        # `d` is the opacity in an MTL file. trimesh keeps its words.
        opacity = material.kwargs.get("d") or ["1"]
        return ["transparency"] if re.fullmatch(r"0?\.\d+|0", opacity[-1]) else []
    if not isinstance(material, PBRMaterial):
        return []
    losses = [words for name, words in _PBR_EXTRAS.items() if getattr(material, name) is not None]
    if material.emissiveFactor is not None and np.any(material.emissiveFactor):
        losses.append("emission")
    is_opaque = material.alphaMode in (None, "OPAQUE")
    return losses if is_opaque or material.baseColorFactor is None else losses + _transparency(material.baseColorFactor)


def _transparency(rgba: np.ndarray) -> list[str]:
    return ["transparency"] if np.any(np.asarray(rgba)[..., 3] < _OPAQUE) else []


def _rgb(rgba: np.ndarray) -> np.ndarray:
    """Returns f32[..., 3] in [0, 1], the colours without alpha."""
    return np.clip(np.asarray(rgba)[..., :3] / np.float32(_OPAQUE), 0.0, 1.0).astype(np.float32)
