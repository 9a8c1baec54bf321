"""What the renderer keeps of a MuJoCo model."""

from __future__ import annotations

import logging

import flax.struct
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array
from mujoco import mjtGeom, mjtLightType, mjtObj, mjtTexture

from vsearch_jax.render.geometry.rays import RAY_FUNCTIONS
from vsearch_jax.render.geometry.triangles import TRIANGLE_TYPES, Triangles, compile_triangles
from vsearch_jax.render.texture.atlas import Textures, compile_textures, rgb_texture

# What MuJoCo's renderer assumes of a geom without a material (mjv_initGeom) ...
_DEFAULT_SPECULAR, _DEFAULT_SHININESS = 0.5, 0.5
# ... a colour with which a geom does not override its material's ...
_DEFAULT_RGBA = np.array([0.5, 0.5, 0.5, 1.0], dtype=np.float32)
# ... the scale of shininess, and the ambient light of a model without any light (render_gl3.c).
_SHININESS_SCALE, _AMBIENT_WITHOUT_LIGHTS = 128.0, 0.3

# Points from which shadow rays start are lifted by this part of the model's extent, far above f32's rounding.
_SHADOW_OFFSET = 1e-4

_LOG = logging.getLogger(__name__)


class RenderError(ValueError):
    """A model holds what the renderer cannot draw; the one-line message names it and says what to do."""


@flax.struct.dataclass
class Lights:
    """The active lights of a model, each in the frame of the body that carries it; L is their number.

    Attributes:
      position: f32[L, 3] m; not used by directional lights.
      direction: f32[L, 3] unit vector along which the light shines.
      ambient: f32[L, 3], added to what the light reaches, whatever the surface's slope.
      diffuse: f32[L, 3].
      specular: f32[L, 3].
      attenuation: f32[L, 3], constant, linear (1/m) and quadratic (1/m^2); not used by directional lights.
      cutoff: f32[L] rad, half angle of a spot's cone.
      exponent: f32[L], a spot's intensity falls off its axis with this power of the cosine.
      is_directional: for each light; static.
      is_shadowing: for each light; static.
      bodies: for each light the body that carries it, 0 for one that is fixed in the world; static.
    """

    position: Array
    direction: Array
    ambient: Array
    diffuse: Array
    specular: Array
    attenuation: Array
    cutoff: Array
    exponent: Array
    is_directional: tuple[bool, ...] = flax.struct.field(pytree_node=False)
    is_shadowing: tuple[bool, ...] = flax.struct.field(pytree_node=False)
    bodies: tuple[int, ...] = flax.struct.field(pytree_node=False)


@flax.struct.dataclass
class RenderScene:
    """Shapes, materials and lights; G is the number of visible geoms, in the order of `geom_ids`.

    Arrays may be replaced inside jit (`scene.replace(rgb=...)`); what is static decides the compiled program.

    Attributes:
      size: f32[G, 3] m, MuJoCo's geom_size.
      rgb: f32[G, 3] in [0, 1].
      specular: f32[G] in [0, 1].
      shininess: f32[G], exponent of the specular highlight (128 times MuJoCo's value).
      emission: f32[G], light given off, in units of `rgb`.
      triangles: the faces of meshes and height fields, or None without such geoms.
      textures: of the geoms and the sky, or None without any.
      lights: Lights.
      headlight_ambient: f32[3], of the light that shines along the camera's axis.
      headlight_diffuse: f32[3].
      headlight_specular: f32[3].
      ambient: f32[3], light from nowhere.
      background: f32[3] in [0, 1], colour of a miss where the model has no skybox.
      shadow_offset: f32[] m, how far shadow rays start off a surface.
      geom_ids: MuJoCo's number of each visible geom; sorted by type, those made of triangles last; static.
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
        """The number of geoms that are not made of triangles, which come first."""
        return sum(kind not in TRIANGLE_TYPES for kind in self.geom_types)


def compile_scene(mj_model: mujoco.MjModel, geom_groups: tuple[int, ...] = (0, 1, 2)) -> RenderScene:
    """Returns the visible geoms, materials and lights of `mj_model`.

    A geom is left out where its colour has alpha 0 or its group is not chosen; any other alpha counts as 1, with a
    warning in the log, also that of textures. Of a material's textures that of the colour counts, of several
    skyboxes the first.

    Args:
      mj_model: the compiled model.
      geom_groups: the geom groups that are drawn; MuJoCo's own renderer draws these by default.

    Raises:
      RenderError: a visible geom is of a type or has a texture that is not supported, a light tracks a body or
        is an image, the model has a visible skin or flex, or no geom is visible.
    """
    rgba = _shown_rgba(mj_model)
    groups = np.clip(mj_model.geom_group, 0, mujoco.mjNGROUP - 1)
    visible = np.flatnonzero((rgba[:, 3] > 0.0) & np.isin(groups, geom_groups))
    if visible.size == 0:
        raise RenderError(
            f"no geom of groups {geom_groups} is visible; choose other geom_groups or give a geom an alpha"
        )
    for geom in visible:
        _check_geom(mj_model, int(geom))
    faint = [mj_model.geom(g).name or f"number {g}" for g in visible.tolist() if rgba[g, 3] < 1.0]
    if faint:
        _LOG.warning("drawn as if they were opaque, though their colour is not: geoms %s", ", ".join(faint))
    _check_soft(mj_model, geom_groups)
    for sky in np.flatnonzero(mj_model.tex_type == mjtTexture.mjTEXTURE_SKYBOX)[:1]:
        _check_texture(mj_model, int(sky), "the sky")
    kinds = mj_model.geom_type[visible]
    ids = visible[np.lexsort((kinds, np.isin(kinds, TRIANGLE_TYPES)))]
    lights = _compile_lights(mj_model)
    headlight = mj_model.vis.headlight
    is_headlight_on = float(headlight.active > 0)
    is_dark = not headlight.active and not lights.is_directional
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
        ambient=_f32(np.full(3, _AMBIENT_WITHOUT_LIGHTS if is_dark else 0.0)),
        background=jnp.zeros(3, dtype=jnp.float32),
        shadow_offset=_f32(_SHADOW_OFFSET * mj_model.stat.extent),
        geom_ids=tuple(int(i) for i in ids),
        geom_types=tuple(int(t) for t in mj_model.geom_type[ids]),
    )


def _f32(values: np.ndarray | float) -> Array:
    return jnp.asarray(values, dtype=jnp.float32)


def _shown_rgba(model: mujoco.MjModel) -> np.ndarray:
    """Returns f32[ngeom, 4]: the geom's colour where it is set or there is no material, else the material's."""
    rgba = np.array(model.geom_rgba)
    takes_material = (model.geom_matid >= 0) & np.all(rgba == _DEFAULT_RGBA, axis=-1)
    rgba[takes_material] = model.mat_rgba[model.geom_matid[takes_material]]
    return rgba


def _material_values(model: mujoco.MjModel, values: np.ndarray, default: float) -> np.ndarray:
    """Returns f32[ngeom] of the materials' `values`, with `default` for geoms without a material."""
    return np.append(values, np.float32(default))[model.geom_matid]


def _check_geom(model: mujoco.MjModel, geom: int) -> None:
    name = f"geom {model.geom(geom).name!r} (number {geom})"
    kind = int(model.geom_type[geom])
    if kind not in RAY_FUNCTIONS and kind not in TRIANGLE_TYPES:
        raise RenderError(
            f"{name} is of type {mjtGeom(kind).name}, which cannot be rendered; replace it by primitives or a mesh, "
            "give it alpha 0 or leave out its group"
        )
    texture = rgb_texture(model, geom)
    if texture >= 0:
        _check_texture(model, texture, name)


def _check_texture(model: mujoco.MjModel, texture: int, wearer: str) -> None:
    if model.tex_nchannel[texture] not in (3, 4):
        raise RenderError(
            f"{wearer} has the texture {model.tex(texture).name!r} of {model.tex_nchannel[texture]} channels, "
            "which cannot be rendered; give it three"
        )


def _check_soft(model: mujoco.MjModel, groups: tuple[int, ...]) -> None:
    for kind, shade, group in (
        (mjtObj.mjOBJ_SKIN, model.skin_rgba, model.skin_group),
        (mjtObj.mjOBJ_FLEX, model.flex_rgba, model.flex_group),
    ):
        for number in range(len(shade)):
            if shade[number, 3] > 0.0 and group[number] in groups:
                name = mujoco.mj_id2name(model, kind, number) or ""
                word = kind.name.removeprefix("mjOBJ_").lower()
                raise RenderError(
                    f"{word} {name!r} (number {number}) cannot be rendered; give it alpha 0 or a group other than "
                    f"{groups}, or replace it by a mesh"
                )


def _compile_lights(model: mujoco.MjModel) -> Lights:
    active = np.flatnonzero(model.light_active)
    for light in active:
        _check_light(model, int(light))
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    mujoco.mj_camlight(model, data)
    bodies = np.where(model.body_weldid[model.light_bodyid[active]] == 0, 0, model.light_bodyid[active])
    is_point = model.light_type[active] == mjtLightType.mjLIGHT_POINT
    return Lights(
        position=_f32(np.where(bodies[:, None] > 0, model.light_pos[active], data.light_xpos[active])),
        direction=_f32(np.where(bodies[:, None] > 0, model.light_dir[active], data.light_xdir[active])),
        ambient=_f32(model.light_ambient[active]),
        diffuse=_f32(model.light_diffuse[active]),
        specular=_f32(model.light_specular[active]),
        attenuation=_f32(model.light_attenuation[active]),
        cutoff=_f32(np.where(is_point, np.pi, np.deg2rad(model.light_cutoff[active]))),
        exponent=_f32(np.where(is_point, 0.0, model.light_exponent[active])),
        is_directional=tuple(bool(t == mjtLightType.mjLIGHT_DIRECTIONAL) for t in model.light_type[active]),
        is_shadowing=tuple(bool(c) for c in model.light_castshadow[active]),
        bodies=tuple(int(b) for b in bodies),
    )


def _check_light(model: mujoco.MjModel, light: int) -> None:
    name = f"light {model.light(light).name!r} (number {light})"
    if model.light_type[light] == mjtLightType.mjLIGHT_IMAGE:
        raise RenderError(f"{name} is an image light, which cannot be rendered; use type directional, spot or point")
    if model.light_mode[light] != mujoco.mjtCamLight.mjCAMLIGHT_FIXED:
        mode = mujoco.mjtCamLight(model.light_mode[light]).name
        raise RenderError(f"{name} has mode {mode}, which cannot be rendered: give it mode fixed, in any body")
