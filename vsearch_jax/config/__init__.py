"""Configuration of a run as frozen, hashable and validated dataclasses.

A `Config` is the static argument of `jax.jit`, the source of the command-line options, and the content of
`config.json`.
"""

from vsearch_jax.config.motion import IKConfig, PlanningConfig
from vsearch_jax.config.parts import EncoderConfig, EnvConfig, EvaluationConfig, SceneConfig, UpAxis
from vsearch_jax.config.searchers import CMAESConfig, RandomSearchConfig, SACConfig
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
    "UpAxis",
]
