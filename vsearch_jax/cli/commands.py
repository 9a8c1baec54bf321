"""What can be said to the `vsearch` command: one dataclass a subcommand, from which tyro makes options and help."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from vsearch_jax.config import PRESETS, Config, SceneConfig

DEFAULT_PRESET = "cpu"


def _option(metavar: str, default: str) -> Any:
    """Returns what --help shows of an option whose default comes from elsewhere."""
    return tyro.conf.arg(metavar=metavar, help_behavior_hint=f"(default: {default})")


_Preset = Annotated[str | None, _option("{" + ",".join(PRESETS) + "}", DEFAULT_PRESET)]
_Name = Annotated[str | None, _option("NAME|PATH", "as below")]
_Input = Annotated[Literal["rgb", "depth", "silhouette"] | None, _option("{rgb,depth,silhouette}", "as below")]


@dataclasses.dataclass(frozen=True)
class Train:
    """Trains encoder and policies, evaluates every searcher and writes a report, all into one new folder."""

    out: Path
    """Folder of the run; it must not exist, or hold nothing, unless --resume is given."""
    preset: _Preset = None
    """Where every value below starts from."""
    seed: Annotated[int | None, _option("INT", "0")] = None
    """Of all random numbers of the run."""
    object: _Name = None
    """Short for --scene.object: a name (see xml/objects) or the path of an MJCF or mesh file."""
    arm: _Name = None
    """Short for --scene.arm: a name (see xml/arm) or the path of an MJCF file."""
    input: _Input = None
    """Short for --encoder.input."""
    resume: tyro.conf.FlagCreatePairsOff[bool] = False
    """Go on with the run in --out from its last checkpoint, with its config."""
    config: Annotated[Config, tyro.conf.arg(name="")] = dataclasses.field(default_factory=Config)


@dataclasses.dataclass(frozen=True)
class Eval:
    """Evaluates a finished run again and writes its results, figures and report anew."""

    run: tyro.conf.Positional[Path]
    """Folder that `vsearch train` made."""
    motion: Annotated[Literal["kinematic", "dynamic"] | None, _option("{kinematic,dynamic}", "the run's")] = None
    """Joints are set, or driven by the arm's dynamics along paths that are planned."""
    reachable: Annotated[Literal["ik", "path"] | None, _option("{ik,path}", "the run's; path if dynamic")] = None
    """A view is reachable where joints for it are free, or where a path to them is found too."""
    out: Annotated[Path | None, _option("PATH", "the run's own")] = None
    """Folder of the results; it must not exist, or hold nothing."""


@dataclasses.dataclass(frozen=True)
class Export:
    """Writes encoder and policy of a finished run as StableHLO files that run without this package."""

    run: tyro.conf.Positional[Path]
    """Folder that `vsearch train` made."""
    out: Path
    """Folder of the files; it must not exist, or hold nothing."""
    seed: int = 0
    """Which of the run's policies."""


@dataclasses.dataclass(frozen=True)
class Reach:
    """Draws which views an arm reaches, and proposes the mount height that best covers a wanted band."""

    out: Path
    """Folder of the pictures; it must not exist, or hold nothing."""
    object: str = "teapot"
    """A name (see xml/objects) or the path of a file."""
    arm: str = "lwr"
    """A name (see xml/arm) or the path of an MJCF file."""
    band: tuple[float, float] = (40.0, 70.0)
    """Lowest and highest elevation wanted, in degrees."""
    heights: tuple[float, float, float] = (0.8, 1.6, 0.05)
    """Lowest and highest mount height to try, and the step between, in m."""
    obstacles: str | None = None
    """What else stands around: a name (see xml/obstacles) or the path of an MJCF file."""
    radius: float = SceneConfig.radius
    """Radius in m of the view sphere."""
    center_height: float = SceneConfig.center_height
    """Height in m of the sphere's centre above the table."""
    mesh_scale: float = SceneConfig.mesh_scale
    """Metres in the unit of the object's mesh file."""


@dataclasses.dataclass(frozen=True)
class Video:
    """Films one search by the first policy of a finished run: the arm, what its camera sees, the target, the cosine."""

    run: tyro.conf.Positional[Path]
    """Folder that `vsearch train` made."""
    out: Path
    """The film, an .mp4 file; it must not exist."""
    motion: Literal["dynamic", "kinematic"] = "dynamic"
    """The arm as its dynamics move it, or exactly on the planned paths."""
    seed: Annotated[int | None, _option("INT", "the search that the run's report shows")] = None
    """Of a random initial view and target."""


Command = Train | Eval | Export | Reach | Video
