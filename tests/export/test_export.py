import dataclasses
import json
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import jax.export
import jax.numpy as jnp
import numpy as np
import pytest

from samples import made_up
from vsearch_jax import encoder as encoders
from vsearch_jax.config import Config, ConfigError
from vsearch_jax.export import stablehlo
from vsearch_jax.export.stablehlo import export
from vsearch_jax.search import sac
from vsearch_jax.types import Image

NUM_JOINTS = 9


def make_config(kind: str) -> Config:
    config = Config.preset("smoke")
    encoder = dataclasses.replace(config.encoder, input=kind)
    return dataclasses.replace(config, encoder=encoder, sac=dataclasses.replace(config.sac, num_seeds=2))


def random_state(config: Config) -> Any:
    """Returns the parts of a TrainState that an export reads, with random values."""
    observation_size = 2 * config.encoder.code_size + NUM_JOINTS
    keys = jax.random.split(jax.random.key(1), config.sac.num_seeds)
    encoder = encoders.init(jax.random.key(0), config)
    return SimpleNamespace(
        encoder=dataclasses.replace(encoder, latent_mean=0.1 * jax.random.normal(keys[0], encoder.latent_mean.shape)),
        sac=jax.vmap(lambda key: sac.init(key, config.sac, observation_size, 2))(keys),
        pool=SimpleNamespace(qpos=jnp.zeros((5, NUM_JOINTS)), camera=SimpleNamespace(fovy=jnp.full(5, 0.5))),
        reach=made_up.reach(),
    )


def pictures(kind: str, count: int, size: int) -> tuple[np.ndarray, Image]:
    """Returns random images as a camera gives them, and as an Image of the renderer."""
    random = np.random.default_rng(0)
    rgb = random.integers(0, 256, (count, size, size, 3), dtype=np.uint8)
    depth = random.uniform(0.1, 0.6, (count, size, size)).astype(np.float32)
    depth[:, 0] = np.inf
    mask = random.integers(0, 2, (count, size, size), dtype=np.uint8)
    image = Image(rgb=rgb.astype(np.float32) / 255, depth=depth, geom_id=np.where(mask > 0, 7, -1))
    return {"rgb": rgb, "depth": depth, "silhouette": mask}[kind], image


@pytest.mark.parametrize("kind", ["rgb", "depth", "silhouette"])
def test_the_exported_functions_equal_the_direct_call(tmp_path: Path, kind: str) -> None:
    config = make_config(kind)
    state = random_state(config)
    export(tmp_path, state, config, policy=1)
    loaded = {
        name: jax.export.deserialize(bytearray((tmp_path / f"{name}.stablehlo").read_bytes()))
        for name in ("encoder", "policy")
    }
    actor = jax.tree.map(lambda x: x[1], state.sac.actor)

    def direct(image: Image, target: jax.Array, qpos: jax.Array) -> tuple[jax.Array, jax.Array]:
        code = encoders.encode(state.encoder, encoders.network_input(image, jnp.asarray([7]), config), config)
        return code, sac.act(None, actor, jnp.concatenate([code, target, qpos]), config.sac)

    for count in (1, 3):
        picture, image = pictures(kind, count, config.scene.image_size)
        target = jax.random.normal(jax.random.key(2), (count, config.encoder.code_size))
        qpos = jax.random.normal(jax.random.key(3), (count, NUM_JOINTS))
        code, action = jax.vmap(direct)(image, target, qpos)
        np.testing.assert_allclose(loaded["encoder"].call(picture), code, atol=1e-4)
        found, similarity = loaded["policy"].call(picture, target, qpos)
        np.testing.assert_allclose(found, action, atol=1e-4)
        norms = np.linalg.norm(code, axis=-1) * np.linalg.norm(target, axis=-1)
        np.testing.assert_allclose(similarity, np.sum(code * target, axis=-1) / norms, atol=1e-4)


def test_the_interface_describes_the_files_and_they_run_without_the_package(tmp_path: Path) -> None:
    config = make_config("rgb")
    export(tmp_path, random_state(config), config)
    about = json.loads((tmp_path / "interface.json").read_text())
    size = config.scene.image_size
    assert about["functions"]["encoder"]["inputs"] == [
        {"name": "picture", "shape": ["batch", size, size, 3], "dtype": "uint8"}
    ]
    assert [x["name"] for x in about["functions"]["policy"]["outputs"]] == ["action", "similarity"]
    assert set(about["functions"]["policy"]["platforms"]) == {"cpu", "cuda", "tpu"}
    assert about["batch"].startswith("1 or more; JAX refuses other dtypes")
    policy = jax.export.deserialize(bytearray((tmp_path / "policy.stablehlo").read_bytes()))

    def act(count: int, code_type: type, picture_type: type = np.uint8) -> np.ndarray:
        code, qpos = (
            np.full((count, config.encoder.code_size), 0.1, code_type),
            np.zeros((count, NUM_JOINTS), code_type),
        )
        return policy.call(np.zeros((count, size, size, 3), picture_type), code, qpos)[0]

    np.testing.assert_array_equal(act(2, np.float64), act(2, np.float32))
    for wrong in ((0, np.float32), (2, np.int32), (2, np.float32, np.float32)):
        with pytest.raises(ValueError, match=r"polymorphic shapes|Dtype mismatch"):
            act(*wrong)
    code = (
        "import sys; from pathlib import Path; import numpy as np; import jax.export;"
        f"f = jax.export.deserialize(bytearray(Path({str(tmp_path / 'encoder.stablehlo')!r}).read_bytes()));"
        f"print(f.call(np.zeros((2, {size}, {size}, 3), np.uint8)).shape, 'vsearch_jax' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == f"(2, {config.encoder.code_size}) False"


def test_a_policy_that_does_not_exist_is_named(tmp_path: Path) -> None:
    config = make_config("rgb")
    with pytest.raises(ConfigError, match="`policy` is 2; allowed: 0 to 1"):
        export(tmp_path, random_state(config), config, policy=2)
    assert not any(tmp_path.iterdir())


def test_a_full_disk_leaves_no_part_of_a_file(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    def fail(descriptor: int) -> None:
        raise OSError("no space")

    made = SimpleNamespace(serialize=lambda: bytearray(b"x" * 50), platforms=(), in_avals=[], out_avals=[])
    monkeypatch.setattr(stablehlo, "_export", lambda *_: made)
    monkeypatch.setattr(stablehlo, "_describe", lambda *_: [])
    config, pool = make_config("rgb"), SimpleNamespace(qpos=np.zeros((5, 9)), camera=SimpleNamespace(fovy=np.ones(5)))
    state: Any = SimpleNamespace(encoder=None, sac=SimpleNamespace(actor={}), pool=pool, reach=made_up.reach())
    monkeypatch.setattr("os.fsync", fail)
    with pytest.raises(OSError, match="no space"):
        export(tmp_path, state, config)
    assert not any(tmp_path.iterdir())
