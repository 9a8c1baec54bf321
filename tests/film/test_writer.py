"""Tests of the film's file: it is complete or absent, and errors name the remedy."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from vsearch_jax.film import FilmError
from vsearch_jax.film.writer import find_ffmpeg, write_film


def test_an_interrupted_film_leaves_no_file(tmp_path: Path) -> None:
    def interrupted_frames():
        yield from np.zeros((50, 32, 32, 3), np.uint8)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_film(tmp_path / "film.mp4", interrupted_frames(), 25, (32, 32))
    assert not any(tmp_path.iterdir())


def test_a_full_disk_is_reported_and_leaves_no_file(tmp_path: Path) -> None:
    code = f"""
import pathlib, resource
import numpy as np
from vsearch_jax.film import FilmError
from vsearch_jax.film.writer import write_film
noise = np.random.default_rng(0).integers(0, 256, (40, 64, 64, 3), dtype=np.uint8)
resource.setrlimit(resource.RLIMIT_FSIZE, (60_000, 60_000))
try:
    write_film(pathlib.Path({str(tmp_path / "film.mp4")!r}), noise, 25, (64, 64))
except FilmError as error:
    print(error)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "film.mp4: the encoder stopped (" in done.stdout and "free space" in done.stdout, done
    assert not done.stderr
    assert not any(tmp_path.iterdir())


def test_a_missing_ffmpeg_is_reported_with_the_extra_that_brings_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)  # makes the import raise ImportError
    with pytest.raises(FilmError, match=r"pip install 'vsearch_jax\[video\]'"):
        find_ffmpeg()
    with pytest.raises(FilmError, match="needs ffmpeg"):
        write_film(tmp_path / "film.mp4", [], 25, (32, 32))
    assert not any(tmp_path.iterdir())


def test_import_of_the_room_needs_neither_ffmpeg_nor_jax() -> None:
    code = "import sys, vsearch_jax.film; print({'imageio_ffmpeg', 'jax'} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "set()"
