"""Configuration of the searchers: random search, CMA-ES and soft actor-critic."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from vsearch_jax.config.validation import require, require_finite, require_positive, require_unit


@dataclass(frozen=True)
class RandomSearchConfig:
    """Random search around the best view so far (thesis 4.1)."""

    num_samples: int = 10
    """Number of views in an epoch."""
    k: float = 1.5
    """Factor k. The standard deviation of the samples is k (1 - best cosine so far), in rad."""
    num_wide: int = 2
    """Number of the views in an epoch that are uniform over the band instead. The thesis has none."""
    max_epochs: int = 30
    """Number of epochs after which the search gives up."""

    def __post_init__(self) -> None:
        require_positive(self, "num_samples", "k", "max_epochs")
        allowed = f"from 0 to below num_samples ({self.num_samples})"
        require(self, "num_wide", 0 <= self.num_wide < self.num_samples, allowed)


@dataclass(frozen=True)
class CMAESConfig:
    """CMA-ES over azimuth and elevation (thesis 4.2)."""

    population: int = 10
    """Number of views in a generation."""
    sigma_deg: float = 90.0
    """Initial standard deviation of the azimuth, in degrees. CMA-ES with restarts has its own."""
    max_generations: int = 30
    """Number of generations after which the search gives up."""
    constraint: Literal["bounds", "penalty"] = "bounds"
    """bounds: samples are moved into the band. penalty: samples may be anywhere; unreachable ones cost 5 (thesis)."""

    def __post_init__(self) -> None:
        require(self, "constraint", self.constraint in ("bounds", "penalty"), "bounds or penalty")
        require(self, "population", self.population >= 4, "4 or more")
        require_positive(self, "sigma_deg", "max_generations")


@dataclass(frozen=True)
class SACConfig:
    """Soft actor-critic with goal relabelling (thesis 4.3)."""

    algorithm: Literal["twin_q", "value"] = "twin_q"
    """twin_q: target critics, temperature adapts. value: state value network, temperature is fixed (thesis)."""
    num_seeds: int = 1
    """Number of policies trained side by side. Each one has its own random numbers."""
    num_envs: int = 16
    """Number of environments that a policy steps at once."""
    num_environment_steps: int = 6_400
    """Number of environment steps of each policy, summed over its environments."""
    num_warmup_steps: int = 512
    """Number of environment steps before the first update. Their actions are uniformly random."""
    updates_per_step: float = 1.0
    """Number of updates for each environment step."""
    batch_size: int = 256
    """Number of transitions in an update."""
    network: Literal["siamese", "plain"] = "siamese"
    """First layers of actor and critic. siamese: shared layers read both codes. plain: one layer reads all (thesis)."""
    hidden_sizes: tuple[int, ...] = (256, 256)
    """Number of units in each hidden layer of actor and critic. The shared layers have the first number twice."""
    learning_rate: float = 1e-3
    """Initial step size of Adam, for actor, critic and temperature. It falls linearly to zero over the run."""
    discount: float = 0.9
    """Discount of future rewards for each step."""
    initial_temperature: float = 0.1
    """Initial temperature, the weight of the entropy. With algorithm `value` it stays."""
    target_entropy: float = -2.0
    """Target of the policy's entropy for each entry of the action, in nats. A uniform action has 0.69."""
    tau: float = 0.02
    """Rate of the target critic's moving average."""
    pool_fraction: float = 0.5
    """Fraction of a batch that are steps between views of the pool, which need no new image."""
    imitation_weight: float = 30.0
    """Weight of the actor's error in pool steps whose target is within one step, where the right action is known."""
    relabel_fraction: float = 0.8
    """Fraction of the replayed steps with a new target: 2/3 of it a random view, 1/3 the view that the step reached."""

    def __post_init__(self) -> None:
        require(self, "algorithm", self.algorithm in ("twin_q", "value"), "twin_q or value")
        require(self, "network", self.network in ("siamese", "plain"), "siamese or plain")
        require_positive(
            self,
            "num_seeds",
            "num_envs",
            "num_environment_steps",
            "updates_per_step",
            "batch_size",
            "learning_rate",
            "initial_temperature",
            "tau",
        )
        is_positive = len(self.hidden_sizes) > 0 and min(self.hidden_sizes) > 0
        require(self, "hidden_sizes", is_positive, "one or more counts, all greater than 0")
        require_unit(self, "discount", "pool_fraction", "relabel_fraction", "tau")
        allowed = f"below {1.0 - 0.5 / self.batch_size:g}, so that a batch of {self.batch_size} holds a real step"
        require(self, "pool_fraction", round(self.pool_fraction * self.batch_size) < self.batch_size, allowed)
        require_finite(self, "target_entropy", "imitation_weight")
        require(self, "imitation_weight", self.imitation_weight >= 0.0, "0 or more")
        require(
            self,
            "num_environment_steps",
            self.num_environment_steps % self.num_envs == 0,
            f"a multiple of num_envs ({self.num_envs})",
        )
        updates = self.updates_per_step * self.num_envs
        allowed = f"values whose product with num_envs ({self.num_envs}) is a whole number"
        require(self, "updates_per_step", updates == int(updates), allowed)
        require(
            self,
            "num_warmup_steps",
            self.num_envs <= self.num_warmup_steps < self.num_environment_steps,
            f"from num_envs ({self.num_envs}) to below num_environment_steps ({self.num_environment_steps})",
        )
