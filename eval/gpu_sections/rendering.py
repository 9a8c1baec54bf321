"""Images per second of the renderer against batch size, image size, scene, shadows and fusion boundary."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

import jax
import jax.numpy as jnp

from benchmarks.render_peers import FOVY, Case, mesh_case, project_case
from gpu_sections.measure import Row, Settings, measure, sweep
from vsearch_jax import render
from vsearch_jax.types import Camera
from vsearch_jax.xla.materialize import override_materialize

NUM_CAMERAS = 64
# Doubled by fours until memory is full.
BATCHES = {128: [1, 16, 64, 256, 1024, 4096, 16384, 65536], 64: [1024, 16384, 65536], 256: [64, 1024, 16384]}
QUICK_BATCHES = {32: [4]}


def run(settings: Settings) -> Iterator[Row]:
    """Yields a row for each program: the project's scene by size and batch, then the variants at the best batch."""
    project = project_case(NUM_CAMERAS)
    best, best_rate = 1, 0.0
    main_size = 32 if settings.is_quick else 128
    for size, batches in (QUICK_BATCHES if settings.is_quick else BATCHES).items():
        for row in sweep(batches, lambda batch, size=size: _row("project", project, (size, batch), True, settings)):
            yield row
            images = row.get("per_second")
            if size == main_size and isinstance(images, float) and images > best_rate:
                best, best_rate = int(row["batch"] or 1), images
    if not settings.is_quick:
        yield _row("project", project, (main_size, best), False, settings)
    for num_faces in (5000,) if settings.is_quick else (5000, 20000):
        mesh = mesh_case(num_faces, NUM_CAMERAS, has_lamp=True)
        for has_shadows in (True,) if settings.is_quick else (False, True):
            yield from sweep(
                [best] if settings.is_quick else [64, 1024, 16384],
                lambda batch, mesh=mesh, has_shadows=has_shadows, name=f"{num_faces} faces": _row(
                    name, mesh, (main_size, batch), has_shadows, settings
                ),
            )
    for is_enabled in (False,) if settings.is_quick else (True, False):
        with override_materialize(is_enabled):
            row = _row("project", project, (main_size, best), True, settings)
        yield {"fusion boundary": is_enabled} | row


def _row(name: str, case: Case, shape: tuple[int, int], has_shadows: bool, settings: Settings) -> Row:
    """Returns the row of one program; `shape` is the image size in pixels and the batch."""
    size, batch = shape
    scene = dataclasses.replace(render.compile_scene(case.model), has_shadows=has_shadows)
    data = render.poses(case.data)
    index = jnp.arange(batch) % NUM_CAMERAS
    positions = jnp.asarray(case.positions, jnp.float32)[index]
    rotations = jnp.asarray(case.rotations, jnp.float32)[index]

    def draw(position: jax.Array, rotation: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        image = render.render(scene, data, Camera(position, rotation, jnp.float32(FOVY)), (size, size))
        return image.rgb, image.depth, image.geom_id

    row = measure(name, batch, settings, jax.vmap(draw), positions, rotations)
    return {"px": size, "shadows": has_shadows} | row
