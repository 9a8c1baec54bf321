"""A whole run's config and the presets; these differ in size only, not in the task."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from typing import Any, Literal, get_args, get_origin, get_type_hints

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
from vsearch_jax.config.validation import ConfigError, require


@dataclass(frozen=True)
class Config:
    """A whole run."""

    scene: SceneConfig = field(default_factory=SceneConfig)
    ik: IKConfig = field(default_factory=IKConfig)
    planning: PlanningConfig = field(default_factory=PlanningConfig)
    encoder: EncoderConfig = field(default_factory=EncoderConfig)
    env: EnvConfig = field(default_factory=EnvConfig)
    random_search: RandomSearchConfig = field(default_factory=RandomSearchConfig)
    cma_es: CMAESConfig = field(default_factory=CMAESConfig)
    sac: SACConfig = field(default_factory=SACConfig)
    evaluation: EvaluationConfig = field(default_factory=EvaluationConfig)
    num_chunks: int = 1
    """Equal parts into which a run is cut: a call of `train` does one. The last is shorter where they don't divide."""

    def __post_init__(self) -> None:
        reduction = self.encoder.stem_stride * 2 ** (len(self.encoder.channels) - 1)
        allowed = f"a multiple of {reduction}, by which the encoder's convolutions divide it"
        require(self.scene, "image_size", self.scene.image_size % reduction == 0, allowed)
        require(
            self,
            "num_chunks",
            0 < self.num_chunks <= self.num_iterations,
            f"from 1 to {self.num_iterations} iterations",
        )

    @property
    def num_policy_iterations(self) -> int:
        """Policy iterations: each steps every environment once."""
        return self.sac.num_environment_steps // self.sac.num_envs

    @property
    def num_iterations(self) -> int:
        """Iterations of the run: encoder updates, then policy iterations."""
        return self.encoder.num_updates + self.num_policy_iterations

    @property
    def chunk_length(self) -> int:
        """Iterations of a chunk."""
        return -(-self.num_iterations // self.num_chunks)

    @staticmethod
    def preset(name: str) -> Config:
        """Returns the preset `name`: smoke, cpu, thesis or gpu.

        Raises:
          ConfigError: no preset has that name.
        """
        if name not in PRESETS:
            raise ConfigError(f"unknown preset {name!r}; allowed: {', '.join(PRESETS)}")
        return PRESETS[name]

    def to_dict(self) -> dict[str, Any]:
        """Returns nested plain values, fit for JSON."""
        return dataclasses.asdict(self)

    @staticmethod
    def from_dict(values: dict[str, Any]) -> Config:
        """Returns the config that `to_dict` wrote.

        Raises:
          ConfigError: a field is unknown or missing, or its value is of another type or out of range.
        """
        return _from_dict(Config, values)


def _from_dict(cls: type, values: dict[str, Any]) -> Any:
    fields = {f.name: f for f in dataclasses.fields(cls)}
    unknown, missing = sorted(set(values) - set(fields)), sorted(set(fields) - set(values))
    if unknown or missing:
        raise ConfigError(
            f"{cls.__name__}: unknown fields {unknown}, missing fields {missing}; expected {sorted(fields)}"
        )
    arguments = {}
    for name, hint in get_type_hints(cls).items():
        value = tuple(values[name]) if isinstance(values[name], list) else values[name]
        if dataclasses.is_dataclass(hint) and isinstance(value, dict):
            value = _from_dict(hint, value)  # pyright: ignore[reportArgumentType] # a hint that is a dataclass is a type
        elif not _fits(value, hint):
            allowed = str(hint).replace("typing.", "") if get_args(hint) else getattr(hint, "__name__", hint)
            raise ConfigError(f"{cls.__name__}.{name} is {value!r}; allowed: {allowed}")
        arguments[name] = value
    return cls(**arguments)


def _fits(value: Any, hint: Any) -> bool:
    """Returns whether `value` is of the type `hint`, one of those that fields of a config have."""
    arguments = get_args(hint)
    if get_origin(hint) is Literal:
        return value in arguments
    if get_origin(hint) is tuple:
        return isinstance(value, tuple) and all(_fits(entry, arguments[0]) for entry in value)
    if arguments:
        return any(_fits(value, argument) for argument in arguments)
    kinds = (int, float) if hint is float else hint
    return isinstance(value, kinds) and (hint is bool or not isinstance(value, bool))


PRESETS: dict[str, Config] = {
    "smoke": Config(
        scene=SceneConfig(image_size=32),
        ik=IKConfig(map_azimuths=12, map_elevations=7, map_seeds=16),
        encoder=EncoderConfig(channels=(8, 16), decoder_size=16, num_updates=8, batch_size=8, pool_size=32),
        sac=SACConfig(num_envs=4, num_environment_steps=64, num_warmup_steps=16, batch_size=32, hidden_sizes=(32, 32)),
        evaluation=EvaluationConfig(num_initial_views=4, num_runs=1, num_episodes=8, batch_size=8),
        num_chunks=4,
    ),
    "cpu": Config(sac=SACConfig(num_seeds=3), num_chunks=36),
    "thesis": Config(
        encoder=EncoderConfig(
            channels=(128, 256, 256, 512),
            stem_stride=2,
            kernel_size=5,
            decoder_size=128,
            num_updates=30_000,
            learning_rate=2e-4,
            pool_size=4096,
        ),
        sac=SACConfig(num_seeds=3, num_environment_steps=10_880),
        num_chunks=767,
    ),
    "gpu": Config(
        encoder=EncoderConfig(num_updates=12_000, batch_size=256, decoder_size=128, pool_size=4096),
        sac=SACConfig(num_seeds=10, num_environment_steps=10_240),
        num_chunks=79,
    ),
}
