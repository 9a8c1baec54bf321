"""Images per second of the renderer against batch size, image size, scene and shadows."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

import jax
import jax.numpy as jnp

from benchmarks.render_peers import FOVY, Case, mesh_case, project_case
from gpu_sections.measure import Row, Settings, measure, sweep
from vsearch_jax import render
from vsearch_jax.types import Camera

BATCHES = [1, 16, 64, 256, 1024, 4096, 16384]
QUICK_BATCHES = [4]
NUM_CAMERAS = 64


def run(settings: Settings) -> Iterator[Row]:
    """Yields a row for each program: a sweep of the batch size first, then the other sizes and scenes at one batch."""
    project = project_case(NUM_CAMERAS)
    batches = QUICK_BATCHES if settings.is_quick else BATCHES
    size = 32 if settings.is_quick else 128
    best, best_rate = batches[0], 0.0
    for row in sweep(batches, lambda batch: _row("project", project, size, True, (batch, settings)), settings):
        yield row
        images = row.get("per_second")
        if isinstance(images, float) and images > best_rate:
            best, best_rate = int(row["batch"] or best), images
    yield _row("project", project, size, False, (best, settings))
    for num_faces in (5000, 20000):
        mesh = mesh_case(num_faces, NUM_CAMERAS, has_lamp=True)
        for has_shadows in (False,) if settings.is_quick else (False, True):
            yield _row(f"{num_faces} faces", mesh, size, has_shadows, (min(best, 1024), settings))
    for other in () if settings.is_quick else (64, 256):
        yield _row("project", project, other, True, (best // 4 if other == 256 else best, settings))


def _row(name: str, case: Case, size: int, has_shadows: bool, how: tuple[int, Settings]) -> Row:
    """Returns the row of one program: scene, image size, shadows, and `how` = (batch, settings)."""
    batch, settings = how
    scene = dataclasses.replace(render.compile_scene(case.model), has_shadows=has_shadows)
    data = render.poses(case.data)
    index = jnp.arange(max(batch, 1)) % NUM_CAMERAS
    positions = jnp.asarray(case.positions, jnp.float32)[index]
    rotations = jnp.asarray(case.rotations, jnp.float32)[index]

    def draw(position: jax.Array, rotation: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        image = render.render(scene, data, Camera(position, rotation, jnp.float32(FOVY)), (size, size))
        return image.rgb, image.depth, image.geom_id

    row = measure(name, batch, settings, jax.vmap(draw), positions, rotations)
    return {"scene": name, "px": size, "shadows": has_shadows} | row
