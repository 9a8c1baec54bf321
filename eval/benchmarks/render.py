"""Measures the renderer side by side with its peers: `python eval/benchmark.py render --out runs/benchmark`."""

from __future__ import annotations

import argparse
import json
import os
import statistics
import time
from collections.abc import Callable
from pathlib import Path

import jax
import numpy as np
import render_peers as peers
from matplotlib.figure import Figure

Row = dict[str, str | int | float]


def images_per_second(draw: Callable[[], object], batch: int, seconds: float) -> float:
    """Returns the median rate of `draw`, called anew for about `seconds` after a first call that compiles."""
    draw()
    times, end = [], time.perf_counter() + seconds
    while time.perf_counter() < end or len(times) < 3:
        start = time.perf_counter()
        draw()
        times.append(time.perf_counter() - start)
    return batch / statistics.median(times)


def _contestants(case: peers.Case, size: int, is_mesh: bool) -> dict[str, Callable[[], Callable[[], object]]]:
    contestants = {
        "vsearch_jax": lambda: peers.ours(case, size, has_shadows=False),
        "vsearch_jax with shadows": lambda: peers.ours(case, size, has_shadows=True),
        f"mj_multiRay, {os.cpu_count()} cores": lambda: peers.multi_ray(case, size),
        f"mujoco.Renderer ({os.environ.get('MUJOCO_GL', 'default')})": lambda: peers.opengl(case, size),
    }
    if is_mesh:
        del contestants["vsearch_jax with shadows"]  # the scene has no light but the headlight
        contestants["embree, 1 core"] = lambda: peers.embree(case, size)
    return contestants


def measure(name: str, case: peers.Case, size: int, seconds: float) -> list[Row]:
    """Returns one row a contestant; those that are not installed are named and left out."""
    rows: list[Row] = []
    batch = len(case.positions)
    for contestant, make in _contestants(case, size, name.endswith("faces")).items():
        try:
            draw = make()
        except Exception as error:  # each library has its own way to say that it cannot run here
            print(f"{name}: {contestant} is left out: {' '.join(str(error).split()) or type(error).__name__}")
            continue
        rate = images_per_second(draw, batch, seconds)
        rows.append({"scene": name, "renderer": contestant, "size": size, "batch": batch, "images_per_second": rate})
        print(f"{name:16s} {size:4d} px  batch {batch:4d}  {contestant:26s} {rate:10.1f} images/s", flush=True)
    return rows


def ratios(rows: list[Row]) -> dict[str, float]:
    """Returns our rate over each peer's, on the same scene, size and batch, and that of 20,000 faces over 5,000."""
    rates = {(r["scene"], r["size"], r["batch"], r["renderer"]): float(r["images_per_second"]) for r in rows}
    result = {}
    for (scene, size, batch, renderer), rate in rates.items():
        own = rates[scene, size, batch, "vsearch_jax"]
        if renderer != "vsearch_jax":
            result[f"{scene}, {size} px, batch {batch}: vsearch_jax / {renderer}"] = own / rate
        if scene == "20000 faces" and ("5000 faces", size, batch, renderer) in rates and renderer == "vsearch_jax":
            result[f"{size} px, batch {batch}: 20000 / 5000 faces"] = own / rates["5000 faces", size, batch, renderer]
    return result


def plot(rows: list[Row], path: Path) -> None:
    """Draws images per second against batch size and resolution, one panel a scene."""
    scenes = sorted({str(row["scene"]) for row in rows})
    figure = Figure(figsize=(5 * len(scenes), 4), layout="constrained")
    for axes, scene in zip(figure.subplots(1, len(scenes), squeeze=False)[0], scenes, strict=True):
        own = [row for row in rows if row["scene"] == scene]
        for key in sorted({(str(row["renderer"]), int(row["size"])) for row in own}):
            line = sorted((r["batch"], r["images_per_second"]) for r in own if (r["renderer"], r["size"]) == key)
            axes.plot(*zip(*line, strict=True), marker="o", label=f"{key[0]}, {key[1]} px")
        axes.set(title=scene, xscale="log", yscale="log", xlabel="batch", ylabel="images per second")
        axes.legend(fontsize="x-small")
    figure.savefig(path, dpi=120)


def compare(cases: dict[str, peers.Case], size: int, path: Path) -> dict[str, float]:
    """Draws what we and mujoco.Renderer see, and ten times the difference, one row a scene.

    Returns:
      The mean absolute difference of each scene, in 255ths of full brightness, outlines and edges of shadows included;
      nothing where there is no OpenGL.
    """
    rows, differences = [], {}
    for name, case in cases.items():
        own = np.asarray(peers.ours(case, size, has_shadows=True)()[0][0])
        try:
            other = peers.opengl(case, size)()[0] / 255.0
        except Exception as error:  # it depends on the machine how this fails
            print(f"pictures are left out: mujoco.Renderer: {' '.join(str(error).split()) or type(error).__name__}")
            return {}
        off = np.abs(own - other)
        differences[name] = 255.0 * float(off.mean())
        rows.append((name, own, other, np.clip(10.0 * off, 0.0, 1.0)))
    figure = Figure(figsize=(9, 3.2 * len(rows)), layout="constrained")
    for axes, (name, *pictures) in zip(figure.subplots(len(rows), 3, squeeze=False), rows, strict=True):
        titles = (f"{name}: vsearch_jax", "mujoco.Renderer", f"10 x difference, mean {differences[name]:.2f}/255")
        for panel, title, picture in zip(axes, titles, pictures, strict=True):
            panel.imshow(np.clip(picture, 0.0, 1.0), interpolation="nearest")
            panel.set_title(title, fontsize="small")
            panel.axis("off")
    figure.savefig(path, dpi=120)
    return differences


def costs(cases: dict[str, peers.Case], size: int) -> dict[str, dict[str, float]]:
    """Returns seconds to compile and memory in MiB an image of each scene, with shadows."""
    result = {}
    for name, case in cases.items():
        seconds, memory = peers.compile_cost(case, size, has_shadows=True)
        result[name] = {"compile_seconds": seconds, "mib_per_image": memory}
        print(f"{name:18s} {size:4d} px  compiled in {seconds:.1f} s, {memory:.2f} MiB an image", flush=True)
    return result


def run(arguments: argparse.Namespace) -> None:
    """Measures all scenes, sizes and batches, prints the ratios, and writes results.json and two pictures."""
    jax.config.update("jax_enable_compilation_cache", False)
    rows: list[Row] = []
    largest = max(arguments.batch)
    lit = {f"{faces} faces, lamp": peers.mesh_case(faces, largest, has_lamp=True) for faces in (5000, 20000)}
    compiled = costs({"project": peers.project_case(largest), **lit}, 128)
    for batch in arguments.batch:
        cases = {"project": peers.project_case(batch)}
        cases |= {f"{faces} faces": peers.mesh_case(faces, batch) for faces in (5000, 20000)}
        for size in arguments.size:
            for name, case in cases.items():
                rows += measure(name, case, size, arguments.seconds)
    result = ratios(rows)
    for name, value in result.items():
        print(f"{value:8.2f}  {name}")
    arguments.out.mkdir(parents=True, exist_ok=True)
    cases = {
        "workshop": peers.workshop_case(),
        "project": peers.project_case(1),
        "5000 faces": peers.mesh_case(5000, 1),
    }
    differences = compare(cases, 384, arguments.out / "pictures.png")
    machine = {"platform": jax.default_backend(), "cores": os.cpu_count(), "jax": jax.__version__}
    report = {"machine": machine, "rows": rows, "ratios": result, "differences": differences, "costs": compiled}
    (arguments.out / "results.json").write_text(json.dumps(report, indent=2))
    plot(rows, arguments.out / "rates.png")


def main() -> None:
    """Reads the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    subparsers = parser.add_subparsers(required=True)
    command = subparsers.add_parser("render", help="rays and pictures against mj_multiRay, OpenGL and embree")
    command.add_argument("--out", type=Path, default=Path("runs/benchmark"))
    command.add_argument("--batch", type=int, nargs="+", default=[1, 16, 64])
    command.add_argument("--size", type=int, nargs="+", default=[64, 128])
    command.add_argument("--seconds", type=float, default=2.0, help="of measuring, for each figure")
    command.set_defaults(run=run)
    arguments = parser.parse_args()
    arguments.run(arguments)


if __name__ == "__main__":
    main()
