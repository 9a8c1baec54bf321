"""The subcommands of `vsearch`: one dataclass for each. tyro makes the options and the help from them."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Annotated, Literal

import tyro

from vsearch_jax.config import PRESETS, Config, SceneConfig, UpAxis

DEFAULT_PRESET = "cpu"


def _option(metavar: str, default: str) -> object:
    """Returns how --help shows an option whose default value is not a constant.

    Args:
      metavar: how the values are shown.
      default: how the default value is shown.
    """
    return tyro.conf.arg(metavar=metavar, help_behavior_hint=f"(default: {default})")


_Preset = Annotated[str | None, _option("{" + ",".join(PRESETS) + "}", DEFAULT_PRESET)]
_Object = Annotated[str | None, _option("NAME|PATH", "value of --scene.object")]
_Arm = Annotated[str | None, _option("NAME|PATH", "value of --scene.arm")]
_Input = Annotated[
    Literal["rgb", "depth", "silhouette"] | None, _option("{rgb,depth,silhouette}", "value of --encoder.input")
]


@dataclasses.dataclass(frozen=True)
class Train:
    """Trains encoder and policies, evaluates every searcher and writes a report, all into one new folder."""

    out: Path
    """Folder of the run. It must not exist, or be empty, unless --resume is given."""
    preset: _Preset = None
    """Preset that sets the default of each option below."""
    seed: Annotated[int | None, _option("INT", "0")] = None
    """Seed of all random numbers of the run."""
    object: _Object = None
    """Short form of --scene.object: a name in xml/objects, or the path of an MJCF or mesh file."""
    arm: _Arm = None
    """Short form of --scene.arm: a name in xml/arm, or the path of an MJCF file."""
    input: _Input = None
    """Short form of --encoder.input."""
    resume: tyro.conf.FlagCreatePairsOff[bool] = False
    """Continue the run in --out from its last checkpoint, with its config."""
    config: Annotated[Config, tyro.conf.arg(name="")] = dataclasses.field(default_factory=Config)


@dataclasses.dataclass(frozen=True)
class Eval:
    """Evaluates a finished run again and writes its results, figures and report again."""

    run: tyro.conf.Positional[Path]
    """Folder that `vsearch train` made."""
    motion: Annotated[Literal["kinematic", "dynamic"] | None, _option("{kinematic,dynamic}", "the run's")] = None
    """kinematic: joint values are set. dynamic: the arm's dynamics follow planned paths."""
    reachable: Annotated[Literal["ik", "path"] | None, _option("{ik,path}", "the run's; path if dynamic")] = None
    """ik: a view is reachable if IK finds collision-free joint values. path: a path to them must be found too."""
    out: Annotated[Path | None, _option("PATH", "the run's own")] = None
    """Folder of the results. It must not exist, or be empty."""


@dataclasses.dataclass(frozen=True)
class Export:
    """Writes encoder and policy of a finished run as StableHLO files, which run without this package."""

    run: tyro.conf.Positional[Path]
    """Folder that `vsearch train` made."""
    out: Path
    """Folder of the files. It must not exist, or be empty."""
    policy: int = 0
    """Number of the policy, from 0."""


@dataclasses.dataclass(frozen=True)
class Reach:
    """Draws which views an arm reaches, and proposes the mount height that covers a band of elevations best."""

    out: Path
    """Folder of the figures. It must not exist, or be empty."""
    object: str = "teapot"
    """A name in xml/objects, or the path of an MJCF or mesh file."""
    arm: str = "lwr"
    """A name in xml/arm, or the path of an MJCF file."""
    band: tuple[float, float] = (40.0, 70.0)
    """Lowest and highest elevation to cover, in degrees."""
    heights: tuple[float, float, float] = (0.8, 1.6, 0.05)
    """Lowest and highest mount height to try, and the step between heights, in m."""
    obstacles: str | None = None
    """Obstacles around the arm: a name in xml/obstacles, or the path of an MJCF file."""
    radius: float = SceneConfig.radius
    """Radius of the view sphere in m."""
    center_height: float = SceneConfig.center_height
    """Height of the view sphere's centre above the table in m."""
    mesh_scale: float = SceneConfig.mesh_scale
    """Length in m of one unit of the object's mesh file."""
    mesh_up: UpAxis = SceneConfig.mesh_up
    """Axis of the object's mesh file that points up. auto: y for GLB and GLTF, as the file says for DAE, else z."""


@dataclasses.dataclass(frozen=True)
class Video:
    """Films one search by the first policy of a finished run: arm, camera image, target and cosine."""

    run: tyro.conf.Positional[Path]
    """Folder that `vsearch train` made."""
    out: Path
    """The film, an .mp4 file. It must not exist."""
    motion: Literal["dynamic", "kinematic"] = "dynamic"
    """dynamic: the arm's dynamics follow the planned paths. kinematic: the arm is exactly on the planned paths."""
    episode: Annotated[int | None, _option("INT", "the search in the run's report")] = None
    """Number of an episode with a random initial view and a random target."""


@dataclasses.dataclass(frozen=True)
class Info:
    """Prints versions, devices and folders, and tests the renderer. Needs no run and no display."""


# With an `Annotated` member this is a `typing.Union`. For a union of plain classes tyro imports typeguard, which takes
# a third of the time of --help.
Command = Annotated[Train, tyro.conf.subcommand("train")] | Eval | Export | Reach | Video | Info

COMMANDS: dict[str, type[Command]] = {
    "train": Train,
    "eval": Eval,
    "export": Export,
    "reach": Reach,
    "video": Video,
    "info": Info,
}
"""The subcommands by name."""
