"""Time of the encoder's training examples by object: `python eval/benchmarks/examples.py --out FILE.json`.

Measures the 64 examples of one update (views, IK, images, augmentation) for the package's teapot and for grey parts
with more and more faces, and what the time goes to. All in one run, so that the ratios do not depend on the machine.
"""

from __future__ import annotations

import argparse
import dataclasses
import functools
import json
import os
import shlex
import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

os.environ.setdefault("JAX_PLATFORMS", "cpu")  # before jax is imported
sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # eval/

import jax
import jax.numpy as jnp
import trimesh
from jax import Array

import vsearch_jax as vs
from parts import PARTS
from vsearch_jax import render, report
from vsearch_jax.env import AUGMENTED, encoder_example, random_example_views
from vsearch_jax.runs import write_atomically

OBJECTS = {"teapot": 0, "plate": 1, "lever": 2, "gear": 2}
"""Object: into how many pieces each edge of its mesh is cut. The teapot has no mesh."""
_BATCH = 64


def milliseconds(function: Callable[[Array], object], repeats: int) -> float:
    """Returns the median time of `function` with a key; the first call compiles and is not counted."""
    compiled, times = jax.jit(function), []
    for i in range(repeats + 1):
        began = time.perf_counter()
        jax.block_until_ready(compiled(jax.random.key(i)))
        times.append(1e3 * (time.perf_counter() - began))
    return statistics.median(times[1:])


def measure(name: str, pieces: int, folder: Path, repeats: int) -> dict[str, str | int | float]:
    """Measures one object. The parts of the time are differences of programs that do more and more.

    Args:
      name: an object of the package, or a key of `PARTS`.
      pieces: pieces of each edge of the part's mesh; 0 for an object of the package.
      folder: for the part's file.
      repeats: number of timed calls of each program.
    """
    config, faces = vs.Config.preset("cpu"), 0
    config = dataclasses.replace(config, encoder=dataclasses.replace(config.encoder, batch_size=_BATCH))
    if pieces:
        mesh = PARTS[name]().refine(pieces).to_mesh()
        faces, path = len(mesh.tri_verts), folder / f"{name}.stl"
        trimesh.Trimesh(mesh.vert_properties[:, :3], mesh.tri_verts, process=False).export(path)
        scene = dataclasses.replace(config.scene, object=str(path), mesh_scale=0.001)
        config = dataclasses.replace(config, scene=scene)
    env, size = vs.ViewSearchEnv(config), (config.scene.image_size, config.scene.image_size)
    unlit = dataclasses.replace(env.render_scene, has_shadows=False)

    def pose(key: Array) -> Array:
        view, qpos = env.random_view(key)
        return env.resolve_view(view, qpos, jnp.bool_(False))[1]

    def image(scene: render.RenderScene, key: Array) -> Array:
        data, camera = env.forward(pose(key))
        return render.render(scene, data, camera, size).rgb

    def examples(key: Array) -> object:
        views = random_example_views(key, env, jnp.bool_(False))
        one = functools.partial(encoder_example, env=env)
        return jax.vmap(one, in_axes=(0, 0, None))(jax.random.split(key, _BATCH), views, jnp.int32(AUGMENTED))

    programs: dict[str, Callable[[Array], object]] = {
        "pose_ms": lambda key: jax.vmap(pose)(jax.random.split(key, _BATCH)),
        "image_ms": lambda key: jax.vmap(functools.partial(image, unlit))(jax.random.split(key, _BATCH)),
        "image_with_shadows_ms": lambda key: jax.vmap(functools.partial(image, env.render_scene))(
            jax.random.split(key, _BATCH)
        ),
        "examples_ms": examples,
    }
    return {"object": name, "faces": faces, **{key: milliseconds(run, repeats) for key, run in programs.items()}}


def main(arguments: list[str]) -> None:
    """Measures all objects and writes the file."""
    parser = argparse.ArgumentParser(description="Measures the encoder's training examples.")
    parser.add_argument("--out", type=Path, required=True, help="JSON file to write")
    parser.add_argument("--repeats", type=int, default=15)
    options = parser.parse_args(arguments)
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for name, pieces in OBJECTS.items():
            row = measure(name, pieces, Path(folder), options.repeats)
            rows.append(row)
            print(json.dumps(row), flush=True)
    ratios = {f"{row['object']}_over_teapot": row["examples_ms"] / rows[0]["examples_ms"] for row in rows[1:]}
    print(ratios)
    command = shlex.join(["python", "eval/benchmarks/examples.py", *arguments])
    content = {"command": command, **report.provenance(), "batch": _BATCH, "rows": rows, "examples_ratios": ratios}
    options.out.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(options.out, json.dumps(content, indent=1) + "\n")


if __name__ == "__main__":
    main(sys.argv[1:])
