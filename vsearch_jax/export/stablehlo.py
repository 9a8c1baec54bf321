"""Writes a trained encoder and policy as StableHLO files. `jax.export` reads them without this package."""

from __future__ import annotations

import functools
import json
import math
from collections.abc import Callable, Sequence
from pathlib import Path

import jax
import jax.export
import jax.numpy as jnp
from flax import nnx
from jax import Array
from jax.core import ShapedArray

from vsearch_jax import encoder as encoders
from vsearch_jax.config import Config, ConfigError
from vsearch_jax.geometry import cosine_similarity
from vsearch_jax.runs.atomic import write_atomically
from vsearch_jax.search import sac
from vsearch_jax.types import EncoderState, Image, TrainState

PLATFORMS = ("cpu", "cuda", "tpu")
"""Platforms on which the files run."""

_INPUT_MEANINGS = {
    "rgb": "uint8; row 0 is the top, the object is in the middle",
    "depth": "metres along the optical axis; inf where nothing was measured",
    "silhouette": "0 off the object, above 0 on it",
}


def encode_picture(picture: Array, *, encoder: EncoderState, config: Config) -> Array:
    """Computes the code of one camera image: the normalised encoder output that the policy reads.

    Args:
      picture: the image as a camera gives it. The type depends on `config.encoder.input`:
        rgb: u8[H, W, 3]; row 0 is the top.
        depth: f32[H, W] m along the optical axis; +inf where nothing was measured.
        silhouette: u8[H, W]; 0 off the object, above 0 on it.
      encoder: a trained EncoderState.
      config: the run's config.

    Returns:
      Code of Z numbers, f32[Z].
    """
    rgb, depth, geom_id = jnp.zeros(()), jnp.zeros(()), jnp.zeros(())
    if config.encoder.input == "rgb":
        rgb = picture.astype(jnp.float32) / 255.0
    elif config.encoder.input == "depth":
        depth = picture
    else:
        geom_id = (picture > 0).astype(jnp.int32)
    image = Image(rgb=rgb, depth=depth, geom_id=geom_id)
    x = encoders.network_input(image, jnp.ones(1, jnp.int32), config)
    return encoders.encode(encoder, x, config)


def policy_step(
    picture: Array, target_code: Array, qpos: Array, *, encoder: EncoderState, actor: nnx.State, config: Config
) -> tuple[Array, Array]:
    """Computes the policy's next camera move (the action) from one camera image.

    Args:
      picture: the image as a camera gives it, as for `encode_picture`.
      target_code: f32[Z], code of the target image, from `encode_picture`.
      qpos: f32[nq] rad or m, present joint values.
      encoder: a trained EncoderState.
      actor: parameters of one policy.
      config: the run's config.

    Returns:
      The action f32[2] in [-1, 1]: change of azimuth and elevation in units of `env.action_scale_deg`. And the cosine
      f32[] between the image's code and the target's code.
    """
    code = encode_picture(picture, encoder=encoder, config=config)
    action = sac.act(None, actor, jnp.concatenate([code, target_code, qpos]), config.sac)
    return action, cosine_similarity(code, target_code)


def export(folder: Path, state: TrainState, config: Config, policy: int = 0) -> None:
    """Exports encoder and one policy as StableHLO files, which run without this package.

    Writes `encoder.stablehlo`, `policy.stablehlo` and `interface.json`, which describes both. Both functions take
    batches of one or more. JAX refuses an empty batch and other dtypes, but rounds float64 to float32. To call one:
    `jax.export.deserialize(bytearray(path.read_bytes())).call(...)`.

    Args:
      folder: folder of the files. It is made if it does not exist.
      state: state of a finished run.
      config: the run's config.
      policy: number of the policy to export, from 0.

    Raises:
      ConfigError: the run has no policy of this number.
      OSError: the disk is full or not writable.
    """
    num_policies = config.sac.num_seeds
    if not 0 <= policy < num_policies:
        raise ConfigError(f"`policy` is {policy}; allowed: 0 to {num_policies - 1}")
    actor = jax.tree.map(lambda x: x[policy], state.sac.actor)
    encode = functools.partial(encode_picture, encoder=state.encoder, config=config)
    act = functools.partial(policy_step, encoder=state.encoder, actor=actor, config=config)
    arguments = _arguments(config, state.pool.qpos.shape[-1])
    exported = {
        "encoder": _export(encode, arguments[:1]),
        "policy": _export(act, arguments),
    }
    folder.mkdir(parents=True, exist_ok=True)
    for name, function in exported.items():
        write_atomically(folder / f"{name}.stablehlo", bytes(function.serialize()))
    interface = json.dumps(_interface(exported, state, config), indent=2) + "\n"
    write_atomically(folder / "interface.json", interface)


def _arguments(config: Config, num_joints: int) -> tuple[jax.ShapeDtypeStruct, ...]:
    """Returns shapes and dtypes of picture, target code and joint values, with a symbolic batch axis."""
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


def _export(function: Callable[..., object], arguments: tuple[jax.ShapeDtypeStruct, ...]) -> jax.export.Exported:
    return jax.export.export(jax.jit(jax.vmap(function)), platforms=PLATFORMS)(*arguments)


def _interface(exported: dict[str, jax.export.Exported], state: TrainState, config: Config) -> dict[str, object]:
    """Returns the content of `interface.json`."""
    names = {
        "encoder": (["picture"], ["code"]),
        "policy": (["picture", "target_code", "qpos"], ["action", "similarity"]),
    }
    functions = {
        name: {
            "file": f"{name}.stablehlo",
            "platforms": list(function.platforms),
            "inputs": _describe(names[name][0], function.in_avals),
            "outputs": _describe(names[name][1], function.out_avals),
        }
        for name, function in exported.items()
    }
    return {
        "functions": functions,
        "policy": "the mean action of the trained policy; the policy has no memory",
        "batch": "1 or more; JAX refuses other dtypes than the given ones, but rounds float64 to float32",
        "meaning": {
            "picture": _INPUT_MEANINGS[config.encoder.input],
            "code": "code of the picture; the policy's target_code is the code of the target picture",
            "qpos": "present joint values of the arm and its gripper, rad or m, in MuJoCo's order",
            "action": f"change of azimuth and elevation, from -1 to 1, in units of {config.env.action_scale_deg:g} "
            "degrees; the arm cannot reach views outside the band",
            "similarity": f"cosine of the two codes; the view is found at {config.env.threshold:g} or more",
        },
        "fovy_deg": math.degrees(float(state.pool.camera.fovy[0])),
        "band_deg": [math.degrees(float(end)) for end in state.reach.band],
        "read": "jax.export.deserialize(bytearray(path.read_bytes())).call(...)",
        "config": config.to_dict(),
    }


def _describe(names: Sequence[str], avals: Sequence[ShapedArray]) -> list[dict[str, object]]:
    """Returns name, shape and dtype of each argument or result. A symbolic axis is its name."""
    return [
        {"name": name, "shape": [n if isinstance(n, int) else str(n) for n in aval.shape], "dtype": str(aval.dtype)}
        for name, aval in zip(names, avals, strict=True)
    ]
