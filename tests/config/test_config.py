"""Presets, validation messages, and the way to JSON and back."""

from __future__ import annotations

import dataclasses
import json

import pytest

from vsearch_jax.config import PRESETS, Config, ConfigError, EncoderConfig, EvaluationConfig, SACConfig, SceneConfig


@pytest.mark.parametrize("name", PRESETS)
def test_a_preset_is_equal_after_json_and_has_an_equal_hash(name):
    config = Config.preset(name)
    restored = Config.from_dict(json.loads(json.dumps(config.to_dict())))
    assert restored == config
    assert hash(restored) == hash(config)


@pytest.mark.parametrize("name", PRESETS)
def test_presets_keep_the_task_of_the_thesis(name):
    config = Config.preset(name)
    assert (config.env.threshold, config.env.action_scale_deg, config.scene.radius) == (0.98, 30.0, 0.35)
    assert config.sac.num_environment_steps <= 11_000
    assert (config.random_search.num_samples, config.cma_es.population, config.random_search.k) == (10, 10, 1.5)


@pytest.mark.parametrize(
    ("build", "field", "value"),
    [
        (lambda: SceneConfig(radius=-0.1), "SceneConfig.radius", "-0.1"),
        (lambda: SceneConfig(image_size=100), "SceneConfig.image_size", "100"),
        (lambda: SceneConfig(mesh_up="up"), "SceneConfig.mesh_up", "up"),
        (lambda: SceneConfig(radius=float("nan")), "SceneConfig.radius", "nan"),
        (lambda: EncoderConfig(input="sound"), "EncoderConfig.input", "sound"),
        (lambda: EncoderConfig(bootstrap_fraction=0.0), "EncoderConfig.bootstrap_fraction", "0.0"),
        (lambda: SACConfig(num_envs=7), "SACConfig.num_environment_steps", "multiple of num_envs"),
        (lambda: SACConfig(discount=1.5), "SACConfig.discount", "from 0 to 1"),
        (lambda: EvaluationConfig(num_initial_views=5), "EvaluationConfig.num_initial_views", "multiple of 4"),
        (lambda: dataclasses.replace(Config.preset("smoke"), num_chunks=0), "Config.num_chunks", "from 1 to"),
    ],
)
def test_the_error_names_field_and_value_out_of_range(build, field, value):
    with pytest.raises(ConfigError) as error:
        build()
    assert field in str(error.value)
    assert value in str(error.value)


def test_the_error_names_the_unknown_preset_and_all_presets():
    with pytest.raises(ConfigError, match=r"`preset` is 'big'; allowed: smoke, cpu, autoencoder, thesis, gpu"):
        Config.preset("big")


def test_the_error_names_unknown_and_missing_fields():
    values = Config.preset("smoke").to_dict()
    values["encoder"]["colour"] = 1
    del values["encoder"]["channels"]
    with pytest.raises(ConfigError, match=r"EncoderConfig: unknown fields \['colour'\], missing fields \['channels'\]"):
        Config.from_dict(values)


@pytest.mark.parametrize(
    ("part", "field", "value"),
    [
        ("scene", "object", 5),
        ("scene", "image_size", 128.0),
        ("scene", "radius", "0.35"),
        ("encoder", "channels", [32, "64"]),
        ("encoder", "input", 1),
        ("sac", "num_seeds", True),
    ],
)
def test_the_error_names_field_and_value_of_the_wrong_type(part, field, value):
    values = Config.preset("smoke").to_dict()
    values[part][field] = value
    with pytest.raises(ConfigError, match=rf"Config\.{field} is .*; allowed: "):
        Config.from_dict(values)
    values[part] = 3
    with pytest.raises(ConfigError, match=rf"Config\.{part} is 3"):
        Config.from_dict(values)


@pytest.mark.parametrize("name", ["cpu", "thesis", "gpu"])
def test_each_chunk_of_a_preset_belongs_to_one_stage(name):
    config = Config.preset(name)
    assert config.chunk_length * config.num_chunks == config.num_iterations
    assert config.encoder.num_updates % config.chunk_length == 0
