"""Configuration of a whole run, and the presets. The presets differ in size, not in the task."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass, field

from vsearch_jax.config.motion import IKConfig, PlanningConfig
from vsearch_jax.config.parsing import parse_dataclass
from vsearch_jax.config.parts import EncoderConfig, EnvConfig, EvaluationConfig, SceneConfig
from vsearch_jax.config.searchers import CMAESConfig, RandomSearchConfig, SACConfig
from vsearch_jax.config.validation import ConfigError, require


@dataclass(frozen=True)
class Config:
    """Configuration of a whole run."""

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
    """Number of equal chunks of a run. `vsearch train` saves after each chunk. The last chunk may be shorter."""

    def __post_init__(self) -> None:
        reduction = self.encoder.stem_stride * 2 ** (len(self.encoder.channels) - 1)
        allowed = f"a multiple of {reduction} (the encoder's convolutions divide the size by it)"
        require(self.scene, "image_size", self.scene.image_size % reduction == 0, allowed)
        if self.encoder.loss != "autoencoder":
            angle, wide = self.encoder.threshold_angle_deg, self.encoder.wide_weight
            low = wide * math.cos(math.radians(angle))
            high = low + 1.0 - wide
            allowed = f"between {low:.4f} and {high:.4f}, with EncoderConfig.threshold_angle_deg {angle:g} and "
            allowed += f"EncoderConfig.wide_weight {wide:g}"
            require(self.env, "threshold", low < self.env.threshold < high, allowed)
        require(
            self,
            "num_chunks",
            0 < self.num_chunks <= self.num_iterations,
            f"from 1 to the run's number of iterations ({self.num_iterations})",
        )

    @property
    def num_policy_iterations(self) -> int:
        """Number of iterations of a run that train the policy. In each, every training environment makes one step."""
        return self.sac.num_environment_steps // self.sac.num_envs

    @property
    def num_iterations(self) -> int:
        """Number of iterations of a run: first the updates of the encoder, then those that train the policy."""
        return self.encoder.num_updates + self.num_policy_iterations

    @property
    def chunk_length(self) -> int:
        """Number of iterations that one call of `train` does (a chunk). The last chunk of a run may be shorter."""
        return -(-self.num_iterations // self.num_chunks)

    @staticmethod
    def preset(name: str) -> Config:
        """Returns a ready-made configuration.

        Args:
          name: smoke (small, for tests), cpu, autoencoder (cpu with the thesis's encoder), thesis or gpu.

        Raises:
          ConfigError: no preset has that name.
        """
        if name not in PRESETS:
            raise ConfigError(f"`preset` is {name!r}; allowed: {', '.join(PRESETS)}")
        return PRESETS[name]

    def to_dict(self) -> dict[str, object]:
        """Returns the configuration as nested plain values, which `json.dumps` accepts."""
        return dataclasses.asdict(self)

    @staticmethod
    def from_dict(values: Mapping[str, object]) -> Config:
        """Builds a configuration from nested plain values. It is the inverse of `to_dict`.

        Args:
          values: value of each field, as `to_dict` returns them.

        Raises:
          ConfigError: a field is unknown or missing, or its value has another type or is out of range.
        """
        return parse_dataclass(Config, values)


PRESETS: dict[str, Config] = {
    "smoke": Config(
        scene=SceneConfig(image_size=32),
        ik=IKConfig(map_azimuths=12, map_elevations=7, map_seeds=16),
        encoder=EncoderConfig(
            channels=(8, 16), hidden_sizes=(32,), decoder_size=16, num_updates=8, batch_size=8, pool_size=32
        ),
        sac=SACConfig(num_envs=4, num_environment_steps=64, num_warmup_steps=16, batch_size=32, hidden_sizes=(32, 32)),
        evaluation=EvaluationConfig(num_initial_views=4, num_runs=1, num_episodes=8, batch_size=8),
        num_chunks=4,
    ),
    "cpu": Config(num_chunks=45),
    "autoencoder": Config(  # the preset cpu with the thesis's loss and optimizer, and a network that suits them
        encoder=EncoderConfig(
            loss="autoencoder",
            shaded_share=0.0,
            intensity="linear",
            optimizer="adam",
            channels=(64, 128, 128),
            hidden_sizes=(),
            num_updates=540,
            learning_rate=1e-3,
        ),
        num_chunks=47,
    ),
    "thesis": Config(
        encoder=EncoderConfig(
            loss="autoencoder",
            shaded_share=0.0,
            intensity="linear",
            optimizer="adam",
            channels=(128, 256, 256, 512),
            stem_stride=2,
            kernel_size=5,
            hidden_sizes=(),
            decoder_size=128,
            num_updates=30_000,
            batch_size=64,
            learning_rate=2e-4,
            pool_size=4096,
        ),
        random_search=RandomSearchConfig(num_wide=0),
        sac=SACConfig(num_seeds=3, num_environment_steps=10_880, network="plain"),
        num_chunks=767,
    ),
    "gpu": Config(
        encoder=EncoderConfig(num_updates=6_000, batch_size=256, pool_size=4096),
        sac=SACConfig(num_seeds=10, num_environment_steps=10_240),
        evaluation=EvaluationConfig(batch_size=500),
        num_chunks=83,
    ),
}
