"""Frozen, hashable, validated configuration: jit's static argument, the command line and `config.json` in one."""

from vsearch_jax.config.motion import IKConfig, PlanningConfig
from vsearch_jax.config.parts import (
    CMAESConfig,
    EncoderConfig,
    EnvConfig,
    EvaluationConfig,
    RandomSearchConfig,
    SACConfig,
    SceneConfig,
)
from vsearch_jax.config.validation import ConfigError
from vsearch_jax.config.whole import PRESETS, Config

__all__ = [
    "PRESETS",
    "CMAESConfig",
    "Config",
    "ConfigError",
    "EncoderConfig",
    "EnvConfig",
    "EvaluationConfig",
    "IKConfig",
    "PlanningConfig",
    "RandomSearchConfig",
    "SACConfig",
    "SceneConfig",
]
