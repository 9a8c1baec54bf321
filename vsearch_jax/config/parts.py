"""The parts of a config, one dataclass for each stage of a run."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from vsearch_jax.config.validation import require, require_finite, require_positive, require_unit


@dataclass(frozen=True)
class SceneConfig:
    """Arm, object and the view sphere around the object."""

    arm: str = "lwr"
    """A name in xml/arm, or the path of an MJCF file with a site `tcp` and a camera `wrist`."""
    object: str = "teapot"
    """A name in xml/objects, or the path of an MJCF or mesh file."""
    mesh_scale: float = 1.0
    """Metres in the unit of the object's mesh file: 0.001 for millimetres."""
    is_mesh_recentred: bool = True
    """Whether the object's mesh is moved over the origin and onto the table; else it stands where its file has it."""
    obstacles: str | None = None
    """What else stands around: a name in xml/obstacles, or the path of an MJCF file in world coordinates."""
    mount_height: float = 1.355
    """Height in m of the arm's base above the table; the arm hangs from it."""
    radius: float = 0.35
    """Radius in m of the view sphere."""
    center_height: float = 0.05
    """Height in m of the sphere's centre above the table."""
    table_clearance: float = 0.01
    """Least distance in m of the arm from the table."""
    image_size: int = 128
    """Height and width in pixels of the image that the encoder reads."""

    def __post_init__(self) -> None:
        require_positive(self, "mount_height", "radius", "image_size", "mesh_scale")
        require_finite(self, "center_height", "table_clearance")
        require(self, "center_height", self.center_height >= 0.0, "0 or more")
        require(self, "table_clearance", self.table_clearance >= 0.0, "0 or more")
        require(self, "image_size", self.image_size % 16 == 0, "a multiple of 16")


@dataclass(frozen=True)
class EncoderConfig:
    """Augmented autoencoder: image to code."""

    input: Literal["rgb", "depth", "silhouette"] = "rgb"
    """What of the image the encoder reads."""
    code_size: int = 128
    """Entries of the code."""
    channels: tuple[int, ...] = (64, 128, 128)
    """Filters of the convolutions; all but the first halve height and width, and the decoder mirrors them."""
    stem_stride: int = 4
    """Stride of the first convolution: 2, or 4 with an 8x8 kernel, at a third of the cost of two of stride 2."""
    kernel_size: int = 3
    """Height and width of the kernels of stride-2 convolutions."""
    decoder_size: int = 64
    """Height and width in pixels of the reconstruction."""
    num_updates: int = 800
    """Optimizer updates."""
    batch_size: int = 64
    """Views rendered for each update."""
    learning_rate: float = 1e-3
    """Adam's peak step size; it decays by a cosine to zero."""
    bootstrap_fraction: float = 0.25
    """Fraction of the pixels, those with the largest error, that enter the loss."""
    whitening_power: float = 0.0
    """Directions of the latent are scaled by their variance to minus this power: 0 leaves them, 0.5 whitens."""
    pool_size: int = 4096
    """Reachable views on which the whitening is fitted and from which training episodes start."""

    def __post_init__(self) -> None:
        require(self, "input", self.input in ("rgb", "depth", "silhouette"), "rgb, depth or silhouette")
        require_positive(self, "code_size", "num_updates", "batch_size", "learning_rate", "decoder_size")
        require(self, "kernel_size", self.kernel_size in (3, 5), "3 or 5")
        require(self, "stem_stride", self.stem_stride in (2, 4), "2 or 4")
        require(
            self,
            "channels",
            len(self.channels) >= 2 and all(c > 0 for c in self.channels),
            "at least two positive counts",
        )
        require(
            self,
            "decoder_size",
            self.decoder_size % 2 ** len(self.channels) == 0,
            f"a multiple of {2 ** len(self.channels)} (a doubling a layer)",
        )
        require_unit(self, "bootstrap_fraction")
        require(self, "bootstrap_fraction", self.bootstrap_fraction > 0.0, "above 0, at most 1")
        require(self, "whitening_power", 0.0 <= self.whitening_power <= 0.5, "from 0 to 0.5")
        require(self, "pool_size", self.pool_size >= 2, "2 or more")


@dataclass(frozen=True)
class EnvConfig:
    """The view-search task (thesis 4.3)."""

    threshold: float = 0.98
    """Cosine similarity at which a view counts as found."""
    action_scale_deg: float = 30.0
    """Change of azimuth and elevation for an action of 1."""
    episode_length: int = 20
    """Steps after which an episode is truncated."""
    success_reward: float = 2.0
    """Reward of the step that meets the threshold."""
    unreachable_reward: float = -2.0
    """Reward of a step to a view that the arm cannot reach; the arm stays."""
    reachable: Literal["ik", "path"] = "ik"
    """A view is reachable where joints for it are free, or where a free path from the present joints is found too."""
    motion: Literal["kinematic", "dynamic"] = "kinematic"
    """Joints are set, or driven along the path by the arm's dynamics; the picture is taken where the arm then is."""

    def __post_init__(self) -> None:
        require(self, "threshold", -1.0 < self.threshold < 1.0, "between -1 and 1")
        require(self, "reachable", self.reachable in ("ik", "path"), "ik or path")
        require(self, "motion", self.motion in ("kinematic", "dynamic"), "kinematic or dynamic")
        allowed = "kinematic where env.reachable is 'ik'; dynamics need env.reachable 'path'"
        require(self, "motion", self.reachable == "path" or self.motion == "kinematic", allowed)
        require(self, "action_scale_deg", 0.0 < self.action_scale_deg <= 180.0, "above 0, at most 180")
        require_positive(self, "episode_length")
        require_finite(self, "success_reward", "unreachable_reward")


@dataclass(frozen=True)
class RandomSearchConfig:
    """Random search around the best view so far (thesis 4.1)."""

    num_samples: int = 10
    """Views sampled in an epoch."""
    k: float = 1.5
    """Standard deviation in rad for each unit of missing cosine."""
    max_epochs: int = 30
    """Epochs after which the search gives up."""

    def __post_init__(self) -> None:
        require_positive(self, "num_samples", "k", "max_epochs")


@dataclass(frozen=True)
class CMAESConfig:
    """CMA-ES over azimuth and elevation (thesis 4.2)."""

    population: int = 10
    """Views sampled in a generation."""
    sigma_deg: float = 90.0
    """Initial standard deviation."""
    max_generations: int = 30
    """Generations after which the search gives up."""

    def __post_init__(self) -> None:
        require(self, "population", self.population >= 4, "4 or more")
        require_positive(self, "sigma_deg", "max_generations")


@dataclass(frozen=True)
class SACConfig:
    """Soft actor-critic with goal relabelling (thesis 4.3)."""

    num_seeds: int = 1
    """Policies trained side by side, each from its own random numbers."""
    num_envs: int = 16
    """Environments a policy steps at once."""
    num_environment_steps: int = 10_240
    """Environment steps of each policy, over all of its environments."""
    num_warmup_steps: int = 512
    """Environment steps with uniform random actions before the first update."""
    updates_per_step: float = 2.0
    """Updates for each environment step."""
    batch_size: int = 256
    """Transitions of an update."""
    hidden_sizes: tuple[int, ...] = (128, 128)
    """Units of the hidden layers of actor and critic."""
    learning_rate: float = 1e-3
    """Adam's first step size of actor, critic and temperature; it falls linearly to zero over the run's updates."""
    discount: float = 0.9
    """Discount of future rewards for each step."""
    initial_temperature: float = 0.1
    """Weight of the entropy before it adapts itself."""
    target_entropy: float = -2.0
    """Entropy in nats for each entry of the action that the temperature steers to; a uniform action has 0.69."""
    tau: float = 0.02
    """Rate of the target critic's moving average."""
    relabel_fraction: float = 0.8
    """Fraction of a batch with another target: in two thirds of it a random view, in a third where the step led."""

    def __post_init__(self) -> None:
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
        require(self, "hidden_sizes", len(self.hidden_sizes) > 0 and min(self.hidden_sizes) > 0, "positive counts")
        require_unit(self, "discount", "relabel_fraction", "tau")
        require_finite(self, "target_entropy")
        require(
            self,
            "num_environment_steps",
            self.num_environment_steps % self.num_envs == 0,
            f"a multiple of num_envs ({self.num_envs})",
        )
        updates = self.updates_per_step * self.num_envs
        require(self, "updates_per_step", updates == int(updates), "updates_per_step * num_envs a whole number")
        require(
            self,
            "num_warmup_steps",
            self.num_envs <= self.num_warmup_steps < self.num_environment_steps,
            "at least num_envs, less than num_environment_steps",
        )


@dataclass(frozen=True)
class EvaluationConfig:
    """What `evaluate` runs."""

    target_azimuth_deg: float = 60.0
    """Target view of random search and CMA-ES."""
    target_elevation_deg: float = 55.0
    """Target view of random search and CMA-ES."""
    num_initial_views: int = 12
    """Initial views of random search and CMA-ES, equal numbers in each quadrant."""
    num_runs: int = 10
    """Runs from each initial view."""
    num_episodes: int = 1000
    """Episodes of each policy, initial view and target both random."""
    patience: int = 7
    """Steps after which a policy that comes no nearer is helped wherever it is; near the target it is at once."""
    batch_size: int = 125
    """Episodes that run side by side."""

    def __post_init__(self) -> None:
        require_positive(self, "num_runs", "num_episodes", "batch_size")
        require(self, "patience", self.patience >= 2, "2 or more")
        require_finite(self, "target_azimuth_deg")
        require(
            self, "num_initial_views", self.num_initial_views > 0 and self.num_initial_views % 4 == 0, "a multiple of 4"
        )
        require(self, "target_elevation_deg", -90.0 <= self.target_elevation_deg <= 90.0, "from -90 to 90")
        require(
            self,
            "num_episodes",
            self.num_episodes % self.batch_size == 0,
            f"a multiple of batch_size ({self.batch_size})",
        )
