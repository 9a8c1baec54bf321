"""A film's file, by ffmpeg."""

from __future__ import annotations

import contextlib
import subprocess
from collections.abc import Iterable
from pathlib import Path
from typing import IO

import numpy as np

from vsearch_jax.runs.atomic import replace_file


class FilmError(ValueError):
    """A film can't be made; the message says why and what to do."""


def find_ffmpeg() -> str:
    """Returns the path of the ffmpeg program that the extra `video` brings.

    Raises:
      FilmError: the extra is not installed.
    """
    try:
        from imageio_ffmpeg import get_ffmpeg_exe
    except ImportError as error:
        raise FilmError("a film needs ffmpeg: pip install 'vsearch_jax[video]'") from error
    return get_ffmpeg_exe()


def write_film(path: Path, frames: Iterable[np.ndarray], fps: int, size: tuple[int, int]) -> int:
    """Writes a film that browsers play (H.264 in MP4), whole or not at all, and returns the number of its frames.

    Args:
      path: where to, ending in .mp4.
      frames: u8[H, W, 3] each.
      fps: frames of a second.
      size: H and W, even.

    Raises:
      FilmError: the encoder stopped, as it does on a full disk.
      OSError: the folder is not writable.
    """
    raw = f"-f rawvideo -pix_fmt rgb24 -s {size[1]}x{size[0]} -r {fps} -i -"
    # faststart: a browser can begin before it has all of the file.
    encoded = "-c:v libx264 -pix_fmt yuv420p -crf 18 -movflags +faststart"
    options = f"-y -loglevel error {raw} {encoded}".split()
    with replace_file(path) as temporary:
        # Not by imageio: its writer forks, which may deadlock beside JAX's threads, and does not tell of a film that
        # could not be finished.
        command = [find_ffmpeg(), *options, str(temporary)]
        pipe = subprocess.PIPE
        with subprocess.Popen(command, stdin=pipe, stdout=subprocess.DEVNULL, stderr=pipe) as encoder:
            try:
                count = _feed(encoder.stdin, frames)
                errors = encoder.stderr.read() if encoder.stderr else b""
            except BaseException:
                encoder.kill()
                raise
        if encoder.returncode != 0:
            *_, reason = [f"status {encoder.returncode}", *errors.decode(errors="replace").splitlines()]
            raise FilmError(f"cannot write {path}: the encoder stopped ({reason}); make room on the disk")
    return count


def _feed(pipe: IO[bytes] | None, frames: Iterable[np.ndarray]) -> int:
    """Writes `frames` into `pipe` until there are no more or nobody reads them; returns how many."""
    assert pipe is not None
    count = 0
    with contextlib.suppress(BrokenPipeError), pipe:
        for frame in frames:
            pipe.write(frame.tobytes())
            count += 1
    return count
