"""Compiles a MuJoCo model to a `RenderScene`: the shapes, materials and lights that the renderer draws."""

from __future__ import annotations

import logging

import flax.struct
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array
from mujoco import mjtGeom, mjtObj, mjtTexture

from vsearch_jax.render.errors import RenderError
from vsearch_jax.render.geometry.coincidence import hidden_geoms
from vsearch_jax.render.geometry.rays import RAY_FUNCTIONS
from vsearch_jax.render.geometry.triangles import TRIANGLE_TYPES, Triangles, compile_triangles
from vsearch_jax.render.lights import Lights, compile_lights
from vsearch_jax.render.texture.atlas import Textures, compile_textures, rgb_texture

# Defaults of MuJoCo's renderer for a geom without a material (mjv_initGeom).
_DEFAULT_SPECULAR, _DEFAULT_SHININESS = 0.5, 0.5
# MuJoCo's default colour. A geom with this colour takes the colour of its material.
_DEFAULT_RGBA = np.array([0.5, 0.5, 0.5, 1.0], dtype=np.float32)
# Exponent of the highlight for shininess 1, and ambient light of a model without any light (render_gl3.c).
_SHININESS_SCALE, _AMBIENT_WITHOUT_LIGHTS = 128.0, 0.3

# Offset of a shadow ray from its surface, as a fraction of the model's extent. Far above the rounding error of f32.
_SHADOW_OFFSET = 1e-4

_LOG = logging.getLogger(__name__)


@flax.struct.dataclass
class RenderScene:
    """Shapes, materials and lights that the renderer draws of a model. G is the number of visible geoms.

    Rows of the geoms have the order of `geom_ids`. Arrays may be replaced under jit with `dataclasses.replace`. Static
    fields determine the compiled program.

    Attributes:
      size: f32[G, 3] m, MuJoCo's geom_size.
      rgb: f32[G, 3] in [0, 1], colours of the geoms.
      specular: f32[G] in [0, 1], strength of the specular highlight.
      shininess: f32[G], exponent of the specular highlight, 128 times MuJoCo's value.
      emission: f32[G], emitted light as a factor of `rgb`.
      triangles: Triangles of the meshes and height fields, or None without such geoms.
      textures: Textures of the geoms and the sky, or None without any.
      lights: the active lights; the headlight is apart.
      headlight_ambient: f32[3]. The headlight is at the camera and shines along its axis.
      headlight_diffuse: f32[3], diffuse light of the headlight.
      headlight_specular: f32[3], light of its highlights.
      ambient: f32[3], ambient light without a source.
      background: f32[3] in [0, 1], colour of a miss if the model has no skybox.
      shadow_offset: f32[] m, offset of a shadow ray from its surface.
      geom_ids: MuJoCo's id of each visible geom, sorted by type, geoms made of triangles last; static.
      geom_types: mjtGeom of each visible geom; static.
      has_shadows: whether lights cast shadows; static.
    """

    size: Array
    rgb: Array
    specular: Array
    shininess: Array
    emission: Array
    triangles: Triangles | None
    textures: Textures | None
    lights: Lights
    headlight_ambient: Array
    headlight_diffuse: Array
    headlight_specular: Array
    ambient: Array
    background: Array
    shadow_offset: Array
    geom_ids: tuple[int, ...] = flax.struct.field(pytree_node=False)
    geom_types: tuple[int, ...] = flax.struct.field(pytree_node=False)
    has_shadows: bool = flax.struct.field(pytree_node=False, default=True)

    @property
    def num_primitives(self) -> int:
        """Number of visible geoms that are not made of triangles. Their rows come first in the scene's arrays."""
        return sum(kind not in TRIANGLE_TYPES for kind in self.geom_types)

    @property
    def shadow_casters(self) -> tuple[int, ...]:
        """Rows of the lights that cast shadows."""
        return tuple(
            row for row, is_shadowing in enumerate(self.lights.is_shadowing) if is_shadowing and self.has_shadows
        )


def compile_scene(mj_model: mujoco.MjModel, geom_groups: tuple[int, ...] = (0, 1, 2)) -> RenderScene:
    """Compiles the visible geoms, the materials and the lights of a model for `render`.

    A geom is invisible if its colour has alpha 0 or its group is not in `geom_groups`. Any other alpha is drawn as 1,
    with a warning in the log. The alpha of textures is ignored. Of a material's textures only the colour texture is
    drawn. Of several skyboxes the first is drawn. Of geoms of one shape in one place, such as a visual and a collision
    geom, the one of the higher group is drawn, then the one of the higher id.

    Args:
      mj_model: the compiled MuJoCo model.
      geom_groups: MuJoCo's geom groups to draw. The default is that of MuJoCo's renderer.

    Returns:
      The scene that `render` draws.

    Raises:
      RenderError: no geom is visible; a visible geom has a type or a texture that is not supported; a light is an image
        light; or a skin or flex is visible.
    """
    rgba = _effective_rgba(mj_model)
    ids = _visible_geoms(mj_model, geom_groups, rgba[:, 3])
    _check_skins_and_flexes(mj_model, geom_groups)
    for sky in np.flatnonzero(mj_model.tex_type == mjtTexture.mjTEXTURE_SKYBOX)[:1]:
        _check_texture(mj_model, int(sky), "the sky")
    lights = compile_lights(mj_model)
    headlight = mj_model.vis.headlight
    is_headlight_on = float(headlight.active > 0)
    is_without_light = not headlight.active and not lights.is_directional
    return RenderScene(
        size=_f32(mj_model.geom_size[ids]),
        rgb=_f32(rgba[ids, :3]),
        specular=_f32(_material_values(mj_model, mj_model.mat_specular, _DEFAULT_SPECULAR)[ids]),
        shininess=_f32(_SHININESS_SCALE * _material_values(mj_model, mj_model.mat_shininess, _DEFAULT_SHININESS)[ids]),
        emission=_f32(_material_values(mj_model, mj_model.mat_emission, 0.0)[ids]),
        triangles=compile_triangles(mj_model, ids[np.isin(mj_model.geom_type[ids], TRIANGLE_TYPES)]),
        textures=compile_textures(mj_model, ids),
        lights=lights,
        headlight_ambient=_f32(headlight.ambient * is_headlight_on),
        headlight_diffuse=_f32(headlight.diffuse * is_headlight_on),
        headlight_specular=_f32(headlight.specular * is_headlight_on),
        ambient=_f32(np.full(3, _AMBIENT_WITHOUT_LIGHTS if is_without_light else 0.0)),
        background=jnp.zeros(3, dtype=jnp.float32),
        shadow_offset=_f32(_SHADOW_OFFSET * mj_model.stat.extent),
        geom_ids=tuple(int(i) for i in ids),
        geom_types=tuple(int(t) for t in mj_model.geom_type[ids]),
    )


def _visible_geoms(model: mujoco.MjModel, geom_groups: tuple[int, ...], alpha: np.ndarray) -> np.ndarray:
    """Returns i64[G], the ids of the visible geoms in the order of `RenderScene.geom_ids`; checks each of them."""
    groups = np.clip(model.geom_group, 0, mujoco.mjNGROUP - 1)
    visible = np.flatnonzero((alpha > 0.0) & np.isin(groups, geom_groups))
    if visible.size == 0:
        raise RenderError(
            f"no geom of the groups {geom_groups} is visible; pass other geom_groups, or give a geom an alpha above 0"
        )
    for geom in visible:
        _check_geom(model, int(geom))
    visible = np.setdiff1d(visible, hidden_geoms(model, visible, alpha))
    transparent = [model.geom(g).name or f"number {g}" for g in visible.tolist() if alpha[g] < 1.0]
    if transparent:
        _LOG.warning("these geoms have an alpha below 1 but are drawn opaque: %s", ", ".join(transparent))
    kinds = model.geom_type[visible]
    return visible[np.lexsort((kinds, np.isin(kinds, TRIANGLE_TYPES)))]


def _f32(values: np.ndarray | float) -> Array:
    return jnp.asarray(values, dtype=jnp.float32)


def _effective_rgba(model: mujoco.MjModel) -> np.ndarray:
    """Returns f32[ngeom, 4]: the material's colour if the geom has a material and the default colour, else its own."""
    rgba = np.array(model.geom_rgba)
    takes_material = (model.geom_matid >= 0) & np.all(rgba == _DEFAULT_RGBA, axis=-1)
    rgba[takes_material] = model.mat_rgba[model.geom_matid[takes_material]]
    return rgba


def _material_values(model: mujoco.MjModel, values: np.ndarray, default: float) -> np.ndarray:
    """Returns f32[ngeom], the entry of `values` of each geom's material, or `default` without a material."""
    return np.append(values, np.float32(default))[model.geom_matid]


def _check_geom(model: mujoco.MjModel, geom: int) -> None:
    name = f"geom {model.geom(geom).name!r} (number {geom})"
    kind = int(model.geom_type[geom])
    if kind not in RAY_FUNCTIONS and kind not in TRIANGLE_TYPES:
        raise RenderError(
            f"{name} is of type {mjtGeom(kind).name}, which cannot be rendered; replace it by primitives or a mesh, "
            "give it alpha 0, or put it in a group that is not drawn"
        )
    texture = rgb_texture(model, geom)
    if texture >= 0:
        _check_texture(model, texture, name)


def _check_texture(model: mujoco.MjModel, texture: int, owner: str) -> None:
    if model.tex_nchannel[texture] not in (3, 4):
        raise RenderError(
            f"{owner} has the texture {model.tex(texture).name!r} with {model.tex_nchannel[texture]} channels, "
            "which cannot be rendered; use a texture with 3 channels"
        )


def _check_skins_and_flexes(model: mujoco.MjModel, groups: tuple[int, ...]) -> None:
    for kind, rgba, group in (
        (mjtObj.mjOBJ_SKIN, model.skin_rgba, model.skin_group),
        (mjtObj.mjOBJ_FLEX, model.flex_rgba, model.flex_group),
    ):
        for number in range(len(rgba)):
            if rgba[number, 3] > 0.0 and group[number] in groups:
                name = mujoco.mj_id2name(model, kind, number) or ""
                noun = kind.name.removeprefix("mjOBJ_").lower()
                raise RenderError(
                    f"{noun} {name!r} (number {number}) cannot be rendered; replace it by a mesh, give it alpha 0, or "
                    f"put it in a group other than {groups}"
                )
