"""One-coloured parts as STL files in mm: `python eval/parts.py --out DIR`.

The parts are what a user's machined parts are like: one grey, with views that resemble one another. Train on one with
`vsearch train --object DIR/plate.stl --scene.mesh-scale 0.001`.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import trimesh
from manifold3d import CrossSection, Manifold

from vsearch_jax.cli.errors import one_line_errors

Size = tuple[float, float, float]
_SEGMENTS = 48
"""Number of flat faces around a cylinder."""


def make_plate() -> Manifold:
    """Returns a plate of 127 x 63 x 35 mm with holes and pockets. Turned by 180 degrees it looks nearly the same."""
    plate = _box((127, 63, 35))
    corners = [(x, y) for x in (-54, 54) for y in (-23, 23)]
    plate -= _union([_hole(4.5, 40, (x, y, -1)) for x, y in corners])
    plate -= _box((36, 34, 16)).translate((-28, 0, 22)) + _box((36, 34, 11)).translate((28, 0, 27))
    plate -= _hole(8, 40, (0, 0, -1)) + _hole(5, 20, (0, 22, 20))
    return plate - _box((24, 8, 14)).translate((-20, -30, 12))


def make_bracket() -> Manifold:
    """Returns an L-shaped bracket of 90 x 60 x 70 mm with a rib and three holes."""
    base, wall = _box((90, 60, 10)), _box((90, 10, 70)).translate((0, 25, 0))
    rib = (
        CrossSection([np.array([(0, 0), (40, 0), (0, 45)], np.float64)])
        .extrude(10)
        .rotate((90, 0, -90))
        .translate((5, 20, 10))
    )
    bore = Manifold.cylinder(30, 14, 14, _SEGMENTS).rotate((90, 0, 0)).translate((-24, 40, 45))
    return base + wall + rib - bore - _hole(5, 20, (-30, -15, -1)) - _hole(5, 20, (30, -15, -1))


def make_gear() -> Manifold:
    """Returns a turned part of 90 mm diameter with 10 teeth and a hub. One hole in its web is the only mark."""
    teeth = _union([_box((16, 14, 24)).translate((38, 0, 0)).rotate((0, 0, 36 * number)) for number in range(10)])
    body = Manifold.cylinder(24, 38, 38, _SEGMENTS) + teeth + Manifold.cylinder(44, 17, 15, _SEGMENTS)
    groove = Manifold.cylinder(10, 32, 32, _SEGMENTS) - Manifold.cylinder(10, 20, 20, _SEGMENTS)
    return body - groove.translate((0, 0, 18)) - _hole(9, 60, (0, 0, -1)) - _hole(6, 40, (26, 0, -1))


def make_flange() -> Manifold:
    """Returns a pipe with a square flange of 80 mm. One of its four bolt holes is larger than the others."""
    flange = _box((80, 80, 12)) + Manifold.cylinder(60, 26, 24, _SEGMENTS)
    bolts = [(x, y) for x in (-31, 31) for y in (-31, 31)]
    sizes = (4.5, 4.5, 4.5, 8.0)
    holes = _union([_hole(size, 20, (x, y, -1)) for (x, y), size in zip(bolts, sizes, strict=True)])
    return flange - holes - _hole(18, 80, (0, 0, -1)) - _box((10, 20, 14)).translate((0, 30, 50))


def make_lever() -> Manifold:
    """Returns a lever of 120 mm with two eyes of nearly equal size."""
    eyes = Manifold.cylinder(30, 22, 22, _SEGMENTS).translate((-42, 0, 0))
    eyes += Manifold.cylinder(24, 19, 19, _SEGMENTS).translate((42, 0, 0))
    arm = _box((84, 20, 14)) + _box((84, 6, 24))
    return eyes + arm - _hole(12, 60, (-42, 0, -1)) - _hole(10, 60, (42, 0, -1))


PARTS: dict[str, Callable[[], Manifold]] = {
    "plate": make_plate,
    "bracket": make_bracket,
    "gear": make_gear,
    "flange": make_flange,
    "lever": make_lever,
}


def write_part(name: str, folder: Path) -> Path:
    """Writes one part as a binary STL file in mm, standing on z = 0, and returns the file's path.

    Args:
      name: a key of `PARTS`.
      folder: where to write `<name>.stl`; it is made if it is missing.
    """
    mesh = PARTS[name]().to_mesh()
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{name}.stl"
    trimesh.Trimesh(mesh.vert_properties[:, :3], mesh.tri_verts, process=False).export(path)
    return path


def _box(size: Size) -> Manifold:
    """Returns a box of `size` mm that stands on z = 0, centred in x and y."""
    return Manifold.cube(size, True).translate((0, 0, size[2] / 2))


def _hole(radius: float, depth: float, bottom: Size) -> Manifold:
    """Returns the cylinder to cut out for a vertical hole, all in mm; `bottom` is the centre of its lower end."""
    return Manifold.cylinder(depth, radius, radius, _SEGMENTS).translate(bottom)


def _union(parts: Sequence[Manifold]) -> Manifold:
    total = Manifold()
    for part in parts:
        total += part
    return total


def main(arguments: list[str]) -> None:
    """Writes all parts."""
    parser = argparse.ArgumentParser(description="Writes one-coloured parts as STL files in mm.")
    parser.add_argument("--out", type=Path, required=True, help="folder for the files")
    options = parser.parse_args(arguments)
    for name in PARTS:
        print(write_part(name, options.out))


if __name__ == "__main__":
    with one_line_errors():
        main(sys.argv[1:])
