"""Configuration of the scene, the encoder, the task and the evaluation."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

from vsearch_jax.config.validation import require, require_finite, require_positive, require_unit

UpAxis = Literal["auto", "x", "y", "z", "-x", "-y", "-z"]
"""Axis of a mesh file that points up; auto: as the file's format defines it."""


@dataclass(frozen=True)
class SceneConfig:
    """Arm, object, and the view sphere around the object."""

    arm: str = "lwr"
    """Name of an arm in xml/arm, or path of an MJCF file. The file needs a site `tcp` and a camera `wrist`."""
    object: str = "teapot"
    """Name of an object in xml/objects, or path of an MJCF or mesh file."""
    mesh_scale: float = 1.0
    """Length of one unit of the object's mesh file, in m. For a file in millimetres it is 0.001."""
    mesh_up: UpAxis = "auto"
    """Axis of the object's mesh file that points up. auto: y for GLB and GLTF, as the file says for DAE, else z."""
    is_mesh_recentred: bool = True
    """Whether the object's mesh is moved over the origin and onto the table. If not, it keeps the file's position."""
    obstacles: str | None = None
    """Name of obstacles in xml/obstacles, or path of an MJCF file in world coordinates. None adds no obstacles."""
    symmetry: int | None = None
    """Number of turns about the vertical that map the object to itself. 1: none, 0: any. None: as its MJCF declares."""
    mount_height: float = 1.355
    """Height of the arm's base above the table, in m. The arm hangs from it."""
    radius: float = 0.35
    """Radius of the view sphere, in m."""
    center_height: float = 0.05
    """Height of the view sphere's centre above the table, in m."""
    table_clearance: float = 0.01
    """Minimum distance between the arm and the table, in m."""
    image_size: int = 128
    """Height and width of the image that the encoder reads, in pixels."""

    def __post_init__(self) -> None:
        require_positive(self, "mount_height", "radius", "image_size", "mesh_scale")
        require_finite(self, "center_height", "table_clearance")
        require(self, "mesh_up", self.mesh_up in get_args(UpAxis), ", ".join(get_args(UpAxis)))
        require(self, "symmetry", self.symmetry is None or self.symmetry >= 0, "0 or more")
        require(self, "center_height", self.center_height >= 0.0, "0 or more")
        require(self, "table_clearance", self.table_clearance >= 0.0, "0 or more")
        require(self, "image_size", self.image_size % 16 == 0, "a multiple of 16")


@dataclass(frozen=True)
class EncoderConfig:
    """Encoder, which maps an image to a code."""

    loss: Literal["autoencoder", "pose", "both"] = "pose"
    """Training: reconstruct the clean view (thesis), match cosines to the known angles between views, or both."""
    threshold_angle_deg: float = 2.5
    """Angle between two views at which the pose loss wants the threshold as cosine, in degrees."""
    wide_weight: float = 0.3
    """Weight of the wide part of the cosine that the pose loss wants. The wide part leads back from the far side."""
    shaded_share: float = 0.75
    """Share of the examples that keep the scene's lights and camera, and get shadows only. The others are augmented."""
    input: Literal["rgb", "depth", "silhouette"] = "rgb"
    """Part of the image that the encoder reads."""
    intensity: Literal["linear", "log"] = "log"
    """Scale on which the network reads rgb. On log a shadow is an offset, which filters can ignore. Depth is linear."""
    code_size: int = 128
    """Number of entries in the code."""
    channels: tuple[int, ...] = (64, 128, 128, 128)
    """Number of filters of each convolution. All but the first halve height and width. The decoder mirrors them."""
    stem_stride: int = 4
    """Stride of the first convolution: 2, or 4 (8x8 kernel). Stride 4 takes 1/3 of the time of two of stride 2."""
    kernel_size: int = 3
    """Height and width of the kernels of stride-2 convolutions, in pixels."""
    hidden_sizes: tuple[int, ...] = (256,)
    """Number of units of each dense layer between the convolutions and the code. Thesis: none."""
    decoder_size: int = 64
    """Height and width of the decoder's image, in pixels."""
    num_updates: int = 500
    """Number of optimizer updates."""
    batch_size: int = 32
    """Number of views rendered for each update."""
    optimizer: Literal["adam", "muon"] = "muon"
    """muon: orthogonal steps for matrices and kernels, Adam for biases. adam: Adam for all parameters (thesis)."""
    learning_rate: float = 8e-3
    """Highest step size of the optimizer; about 0.001 suits adam. It decays to zero along a cosine."""
    bootstrap_fraction: float = 0.25
    """Fraction of the pixels that enter the loss. They are the pixels with the largest error."""
    whitening_power: float = 0.0
    """Power p: each direction of the latent is scaled by its variance to the power -p. 0 is off; 0.5 whitens fully."""
    pool_size: int = 4096
    """Number of reachable views in the pool. The whitening is fitted to them. Training episodes start from them."""

    def __post_init__(self) -> None:
        require(self, "loss", self.loss in ("autoencoder", "pose", "both"), "autoencoder, pose or both")
        require(self, "input", self.input in ("rgb", "depth", "silhouette"), "rgb, depth or silhouette")
        require(self, "intensity", self.intensity in ("linear", "log"), "linear or log")
        require(self, "optimizer", self.optimizer in ("adam", "muon"), "adam or muon")
        require(self, "threshold_angle_deg", 0.0 < self.threshold_angle_deg <= 30.0, "greater than 0, at most 30")
        require(self, "wide_weight", 0.0 <= self.wide_weight <= 0.9, "from 0 to 0.9")
        require_positive(self, "code_size", "num_updates", "batch_size", "learning_rate", "decoder_size")
        has_pairs = self.loss == "autoencoder" or self.batch_size >= 4
        require(self, "batch_size", has_pairs, "4 or more, because the pose loss compares pairs of views")
        require(self, "kernel_size", self.kernel_size in (3, 5), "3 or 5")
        require(self, "stem_stride", self.stem_stride in (2, 4), "2 or 4")
        require(
            self,
            "channels",
            len(self.channels) >= 2 and all(c > 0 for c in self.channels),
            "at least two counts, all greater than 0",
        )
        require(self, "hidden_sizes", all(size > 0 for size in self.hidden_sizes), "counts greater than 0, or none")
        require(
            self,
            "decoder_size",
            self.decoder_size % 2 ** len(self.channels) == 0,
            f"a multiple of {2 ** len(self.channels)} (each layer of the decoder doubles the size)",
        )
        require_unit(self, "bootstrap_fraction", "shaded_share")
        require(self, "bootstrap_fraction", self.bootstrap_fraction > 0.0, "greater than 0, at most 1")
        require(self, "whitening_power", 0.0 <= self.whitening_power <= 0.5, "from 0 to 0.5")
        is_free = self.loss == "autoencoder" or self.whitening_power == 0.0
        require(
            self, "whitening_power", is_free, "0, because whitening would change the cosines that the pose loss wants"
        )
        require(self, "pool_size", self.pool_size >= 2, "2 or more")


@dataclass(frozen=True)
class EnvConfig:
    """The view-search task (thesis 4.3)."""

    target: Literal["random", "fixed"] = "random"
    """Target of an episode. random: any reachable view. fixed: the evaluation's target view (thesis)."""
    threshold: float = 0.98
    """Cosine similarity at which a view counts as found."""
    action_scale_deg: float = 30.0
    """Change of azimuth and elevation for an action of 1, in degrees."""
    episode_length: int = 20
    """Number of steps after which an episode is truncated."""
    success_reward: float = 2.0
    """Reward of the step that meets the threshold."""
    unreachable_reward: float = -2.0
    """Reward of a step to a view that the arm cannot reach. The arm does not move in such a step."""
    reachable: Literal["ik", "path"] = "ik"
    """Condition of a reachable view. ik: it has collision-free joints. path: a collision-free path also leads there."""
    motion: Literal["kinematic", "dynamic"] = "kinematic"
    """Motion of the arm. kinematic: the joints are set. dynamic: the arm's simulated dynamics follow the path."""

    def __post_init__(self) -> None:
        require(self, "target", self.target in ("random", "fixed"), "random or fixed")
        require(self, "threshold", -1.0 < self.threshold < 1.0, "between -1 and 1")
        require(self, "reachable", self.reachable in ("ik", "path"), "ik or path")
        require(self, "motion", self.motion in ("kinematic", "dynamic"), "kinematic or dynamic")
        allowed = "kinematic where env.reachable is 'ik'; dynamic needs env.reachable 'path'"
        require(self, "motion", self.reachable == "path" or self.motion == "kinematic", allowed)
        require(self, "action_scale_deg", 0.0 < self.action_scale_deg <= 180.0, "greater than 0, at most 180")
        require_positive(self, "episode_length")
        require_finite(self, "success_reward", "unreachable_reward")


@dataclass(frozen=True)
class EvaluationConfig:
    """Number and kind of the searches that `evaluate` runs."""

    target_azimuth_deg: float = 60.0
    """Azimuth of the target view of random search and CMA-ES, in degrees."""
    target_elevation_deg: float = 55.0
    """Elevation of the target view of random search and CMA-ES, in degrees."""
    num_initial_views: int = 12
    """Number of initial views of random search and CMA-ES. Each quadrant has the same number."""
    num_runs: int = 10
    """Number of runs from each initial view."""
    num_episodes: int = 1000
    """Number of episodes of each policy. The initial view is random, and the target as `env.target` says."""
    patience: int = 7
    """Number of steps before a local search helps a stalled policy. Near the target, one step of stalling is enough."""
    batch_size: int = 125
    """Number of episodes that run side by side."""

    def __post_init__(self) -> None:
        require_positive(self, "num_runs", "num_episodes", "batch_size")
        require(self, "patience", self.patience >= 2, "2 or more")
        require_finite(self, "target_azimuth_deg")
        require(
            self, "num_initial_views", self.num_initial_views > 0 and self.num_initial_views % 4 == 0, "a multiple of 4"
        )
        require(self, "target_elevation_deg", -90.0 <= self.target_elevation_deg <= 90.0, "from -90 to 90")
