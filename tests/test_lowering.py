"""`train` and `evaluate` lower for CUDA and TPU: every operation has a translation for these platforms."""

import dataclasses
import functools
import re

import jax
import jax.export
import pytest

import vsearch_jax as vs

# Silhouettes: all loops are there, and less code is traced.
_SMOKE = vs.Config.preset("smoke")
CONFIG = dataclasses.replace(_SMOKE, encoder=dataclasses.replace(_SMOKE.encoder, input="silhouette"))


@pytest.fixture(scope="module")
def state():
    return jax.eval_shape(functools.partial(vs.init, config=CONFIG), jax.random.key(0))


@pytest.mark.parametrize("function", [vs.train, vs.evaluate], ids=["train", "evaluate"])
def test_a_whole_run_lowers_for_cuda_and_tpu(function, state, monkeypatch: pytest.MonkeyPatch) -> None:
    # What depends on the platform (lanes, tiles, convolutions, the fusion boundary) is traced as on a GPU.
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    program = jax.jit(functools.partial(function, config=CONFIG))
    exported = jax.export.export(program, platforms=("cuda", "tpu"))(state)
    assert exported.platforms == ("cuda", "tpu")
    text = exported.mlir_module()
    assert len(re.findall(r"stablehlo\.while", text)) > 20
    # A callback would run on the host at every step.
    assert "callback" not in text
