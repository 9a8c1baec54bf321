"""A trained encoder and policy as StableHLO files, which `jax.export` reads back without this package."""

from __future__ import annotations

import functools
import json
import math
from pathlib import Path
from typing import Any

import jax
import jax.export
import jax.numpy as jnp
from jax import Array

from vsearch_jax import encoder as encoders
from vsearch_jax.config import Config, ConfigError
from vsearch_jax.geometry import cosine_similarity
from vsearch_jax.search import sac
from vsearch_jax.types import EncoderState, Image, TrainState

PLATFORMS = ("cpu", "cuda", "tpu")
"""Where the files run."""


def encode_picture(picture: Array, *, encoder: EncoderState, config: Config) -> Array:
    """Returns the code f32[Z] of one picture as a camera gives it.

    Args:
      picture: by `config.encoder.input`: rgb u8[H, W, 3]; depth f32[H, W] m along the optical axis, +inf where there is
        none; silhouette u8[H, W], 0 off the object.
      encoder: a trained EncoderState.
      config: the run's.
    """
    blank = Image(rgb=jnp.zeros(()), depth=jnp.zeros(()), geom_id=jnp.zeros(()))
    images = {
        "rgb": lambda: blank.replace(rgb=picture.astype(jnp.float32) / 255.0),  # pyright: ignore[reportAttributeAccessIssue]
        "depth": lambda: blank.replace(depth=picture),  # pyright: ignore[reportAttributeAccessIssue] # flax adds it
        "silhouette": lambda: blank.replace(geom_id=(picture > 0).astype(jnp.int32)),  # pyright: ignore[reportAttributeAccessIssue]
    }
    x = encoders.network_input(images[config.encoder.input](), jnp.ones(1, jnp.int32), config)
    return encoders.encode(encoder, x, config)


def policy_step(
    picture: Array, target_code: Array, qpos: Array, *, encoder: EncoderState, actor: Any, config: Config
) -> tuple[Array, Array]:
    """Returns where the policy would move next, f32[2] in [-1, 1], and the picture's cosine f32[] with the target.

    Args:
      picture: see `encode_picture`.
      target_code: f32[Z], code of the target picture.
      qpos: f32[nq] rad or m, present joints.
      encoder: a trained EncoderState.
      actor: parameters of one policy.
      config: the run's.
    """
    code = encode_picture(picture, encoder=encoder, config=config)
    action = sac.act(None, actor, jnp.concatenate([code, target_code, qpos]), config.sac)
    return action, cosine_similarity(code, target_code)


def export(folder: Path, state: TrainState, config: Config, seed: int = 0) -> None:
    """Writes encoder.stablehlo, policy.stablehlo and interface.json, which describes both, into `folder`.

    Both take batches of any size. To call one:
    `jax.export.deserialize(bytearray(path.read_bytes())).call(...)`.

    Args:
      folder: where to; made if it is not there.
      state: of a finished run.
      config: the run's config.
      seed: which of the run's policies.

    Raises:
      ConfigError: the run has no policy of that number.
      OSError: the disk is full or not writable.
    """
    num_seeds = config.sac.num_seeds
    if not 0 <= seed < num_seeds:
        raise ConfigError(f"policy {seed} does not exist; allowed: 0 to {num_seeds - 1}")
    actor = jax.tree.map(lambda x: x[seed], state.sac.actor)
    encode = functools.partial(encode_picture, encoder=state.encoder, config=config)
    act = functools.partial(policy_step, encoder=state.encoder, actor=actor, config=config)
    arguments = _arguments(config, state.pool.qpos.shape[-1])
    exported = {
        "encoder": _export(encode, arguments[:1]),
        "policy": _export(act, arguments),
    }
    folder.mkdir(parents=True, exist_ok=True)
    for name, function in exported.items():
        (folder / f"{name}.stablehlo").write_bytes(function.serialize())
    (folder / "interface.json").write_text(
        json.dumps(_interface(exported, state, config), indent=2) + "\n", encoding="utf-8"
    )


def _arguments(config: Config, num_joints: int) -> tuple[jax.ShapeDtypeStruct, ...]:
    (batch,) = jax.export.symbolic_shape("batch")
    size = config.scene.image_size
    picture = {
        "rgb": jax.ShapeDtypeStruct((batch, size, size, 3), jnp.uint8),
        "depth": jax.ShapeDtypeStruct((batch, size, size), jnp.float32),
        "silhouette": jax.ShapeDtypeStruct((batch, size, size), jnp.uint8),
    }
    return (
        picture[config.encoder.input],
        jax.ShapeDtypeStruct((batch, config.encoder.code_size), jnp.float32),
        jax.ShapeDtypeStruct((batch, num_joints), jnp.float32),
    )


def _export(function: Any, arguments: tuple[jax.ShapeDtypeStruct, ...]) -> jax.export.Exported:
    return jax.export.export(jax.jit(jax.vmap(function)), platforms=PLATFORMS)(*arguments)


def _interface(exported: dict[str, jax.export.Exported], state: TrainState, config: Config) -> dict[str, Any]:
    meanings = {
        "encoder": (["picture"], ["code"]),
        "policy": (["picture", "target_code", "qpos"], ["action", "similarity"]),
    }
    functions = {
        name: {
            "file": f"{name}.stablehlo",
            "platforms": list(function.platforms),
            "inputs": _describe(meanings[name][0], function.in_avals),
            "outputs": _describe(meanings[name][1], function.out_avals),
        }
        for name, function in exported.items()
    }
    return {
        "functions": functions,
        "policy": "the mean of the trained policy; it keeps no memory of the episode",
        "meaning": {
            "picture": {
                "rgb": "uint8, row 0 is the top, the object in the middle",
                "depth": "metres along the optical axis, inf where nothing was measured",
                "silhouette": "0 off the object",
            }[config.encoder.input],
            "code": "of a picture; that of the target picture is the policy's target_code",
            "qpos": "present joints of the arm and its gripper, rad and m, in MuJoCo's order",
            "action": f"change of azimuth and elevation, from -1 to 1, in {config.env.action_scale_deg:g} degrees; a "
            "view off the band's elevations is out of reach",
            "similarity": f"cosine of the two codes; the view is found from {config.env.threshold:g} on",
        },
        "fovy_deg": math.degrees(float(state.pool.camera.fovy[0])),
        "band_deg": [math.degrees(float(end)) for end in state.reach.band],
        "read": "jax.export.deserialize(bytearray(path.read_bytes())).call(...)",
        "config": config.to_dict(),
    }


def _describe(names: list[str], avals: Any) -> list[dict[str, Any]]:
    return [
        {"name": name, "shape": [str(n) if not isinstance(n, int) else n for n in aval.shape], "dtype": str(aval.dtype)}
        for name, aval in zip(names, avals, strict=True)
    ]
