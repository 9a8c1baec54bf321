"""Compares the renderer with its peers in one run: `python eval/benchmarks/render.py --out runs/benchmark`.

The peers are mj_multiRay, mujoco.Renderer and embree. Install them with the extra `benchmark`.
"""

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
from matplotlib.figure import Figure

import render_peers as peers

Row = dict[str, str | int | float]
"""One measurement: scene, renderer, size in pixels, batch, images_per_second."""

OURS = "vsearch_jax"


def images_per_second(draw: Callable[[], object], batch: int, seconds: float) -> float:
    """Returns the median rate of `draw`. The first call compiles and is not counted.

    Args:
      draw: renders one batch and waits for the result.
      batch: images of one call.
      seconds: measuring time. At least three calls are made.
    """
    draw()
    times, end = [], time.perf_counter() + seconds
    while time.perf_counter() < end or len(times) < 3:
        start = time.perf_counter()
        draw()
        times.append(time.perf_counter() - start)
    return batch / statistics.median(times)


def _renderers(case: peers.Case, size: int, is_mesh: bool) -> dict[str, Callable[[], Callable[[], object]]]:
    """Returns for each renderer a function that makes its `draw`; it raises where the renderer is missing."""
    renderers = {
        OURS: lambda: peers.ours(case, size, has_shadows=False),
        f"{OURS} with shadows": lambda: peers.ours(case, size, has_shadows=True),
        f"mj_multiRay, {os.cpu_count()} cores": lambda: peers.multi_ray(case, size),
        f"mujoco.Renderer ({os.environ.get('MUJOCO_GL', 'default')})": lambda: peers.opengl(case, size),
    }
    if is_mesh:
        del renderers[f"{OURS} with shadows"]  # the headlight is the scene's only light, and casts no shadow
        renderers["embree, 1 core"] = lambda: peers.embree(case, size)
    return renderers


def measure(name: str, case: peers.Case, size: int, seconds: float) -> list[Row]:
    """Measures every renderer on one scene. A renderer that does not run on this machine is reported and left out.

    Args:
      name: name of the scene.
      case: the scene and its cameras.
      size: edge of an image in pixels.
      seconds: measuring time of each renderer.

    Returns:
      One row for each renderer.
    """
    rows: list[Row] = []
    batch = len(case.positions)
    for renderer, make in _renderers(case, size, name.endswith("faces")).items():
        try:
            draw = make()
        except Exception as error:  # each library raises an error of its own
            print(f"{name}: {renderer} is left out: {_one_line(error)}")
            continue
        rate = images_per_second(draw, batch, seconds)
        rows.append({"scene": name, "renderer": renderer, "size": size, "batch": batch, "images_per_second": rate})
        print(f"{name:16s} {size:4d} px  batch {batch:4d}  {renderer:26s} {rate:10.1f} images/s", flush=True)
    return rows


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split()) or type(error).__name__


def ratios(rows: list[Row]) -> dict[str, float]:
    """Returns the ratio of our rate to each peer's rate, and of our rate with 20,000 faces to that with 5,000.

    Both rates of a ratio are of one size and batch.
    """
    rates = {(r["scene"], r["size"], r["batch"], r["renderer"]): float(r["images_per_second"]) for r in rows}
    result = {}
    for (scene, size, batch, renderer), rate in rates.items():
        own = rates[scene, size, batch, OURS]
        if renderer != OURS:
            result[f"{scene}, {size} px, batch {batch}: {OURS} / {renderer}"] = own / rate
        if scene == "20000 faces" and ("5000 faces", size, batch, renderer) in rates and renderer == OURS:
            result[f"{size} px, batch {batch}: 20000 / 5000 faces"] = own / rates["5000 faces", size, batch, renderer]
    return result


def plot(rows: list[Row], path: Path) -> None:
    """Draws images per second over batch size, one panel for each scene and one line for each renderer and size.

    Args:
      rows: measurements.
      path: picture file to write.
    """
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
    """Draws our image, that of mujoco.Renderer, and ten times their difference. There is one row for each scene.

    Args:
      cases: scenes by name; the first camera of each is drawn.
      size: edge of an image in pixels.
      path: picture file to write.

    Returns:
      Mean absolute difference of each scene, in 1/255 of full brightness. Outlines and shadow edges are included. Empty
      if there is no OpenGL on this machine; then no file is written.
    """
    rows, differences = [], {}
    for name, case in cases.items():
        own = np.asarray(peers.ours(case, size, has_shadows=True)()[0][0])
        try:
            other = peers.opengl(case, size)()[0] / 255.0
        except Exception as error:  # the type depends on the machine
            print(f"pictures are left out: mujoco.Renderer: {_one_line(error)}")
            return {}
        error = np.abs(own - other)
        differences[name] = 255.0 * float(error.mean())
        rows.append((name, own, other, np.clip(10.0 * error, 0.0, 1.0)))
    figure = Figure(figsize=(9, 3.2 * len(rows)), layout="constrained")
    for axes, (name, *images) in zip(figure.subplots(len(rows), 3, squeeze=False), rows, strict=True):
        titles = (f"{name}: {OURS}", "mujoco.Renderer", f"10 x difference, mean {differences[name]:.2f}/255")
        for panel, title, image in zip(axes, titles, images, strict=True):
            panel.imshow(np.clip(image, 0.0, 1.0), interpolation="nearest")
            panel.set_title(title, fontsize="small")
            panel.axis("off")
    figure.savefig(path, dpi=120)
    return differences


def costs(cases: dict[str, peers.Case], size: int) -> dict[str, dict[str, float]]:
    """Returns compile time in s and memory in MiB per image of each scene, with shadows.

    Args:
      cases: scenes by name.
      size: edge of an image in pixels.
    """
    result = {}
    for name, case in cases.items():
        seconds, memory = peers.compile_cost(case, size, has_shadows=True)
        result[name] = {"compile_seconds": seconds, "mib_per_image": memory}
        print(f"{name:18s} {size:4d} px  compiled in {seconds:.1f} s, {memory:.2f} MiB per image", flush=True)
    return result


def run(arguments: argparse.Namespace) -> None:
    """Measures all scenes, sizes and batches. Prints the ratios, and writes results.json and two pictures."""
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
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("runs/benchmark"), help="folder to write")
    parser.add_argument("--batch", type=int, nargs="+", default=[1, 16, 64], help="images of one batch")
    parser.add_argument("--size", type=int, nargs="+", default=[64, 128], help="edge of an image in pixels")
    parser.add_argument("--seconds", type=float, default=2.0, help="measuring time of each rate")
    run(parser.parse_args())


if __name__ == "__main__":
    main()
