"""Writes a film's file with ffmpeg."""

from __future__ import annotations

import contextlib
import subprocess
from collections.abc import Iterable
from pathlib import Path
from typing import IO

import numpy as np

from vsearch_jax.runs.atomic import replace_file


class FilmError(ValueError):
    """A film cannot be made. The message says why and gives the remedy."""


def find_ffmpeg() -> str:
    """Returns the path of the ffmpeg program that the package imageio-ffmpeg brings.

    Raises:
      FilmError: imageio-ffmpeg is not installed. The extra `video` installs it.
    """
    try:
        from imageio_ffmpeg import get_ffmpeg_exe
    except ImportError as error:
        raise FilmError(
            "a film needs ffmpeg, which is not installed; install the extra `video`: pip install 'vsearch_jax[video]'"
        ) from error
    return get_ffmpeg_exe()


def write_film(path: Path, frames: Iterable[np.ndarray], fps: int, size: tuple[int, int]) -> int:
    """Writes frames as a film that browsers can play (H.264 in MP4). After an error no file is left.

    Args:
      path: the new file; the name ends in .mp4.
      frames: the images of the film, u8[H, W, 3] each.
      fps: frames per second.
      size: height H and width W of the frames in pixels, both even.

    Returns:
      Number of frames in the film.

    Raises:
      FilmError: ffmpeg is not installed, or the encoder stopped, for example on a full disk.
      OSError: the folder is not writable.
    """
    raw = f"-f rawvideo -pix_fmt rgb24 -s {size[1]}x{size[0]} -r {fps} -i -"
    # faststart: a browser can start to play before it has the whole file.
    encoded = "-c:v libx264 -pix_fmt yuv420p -crf 18 -movflags +faststart"
    options = f"-y -loglevel error {raw} {encoded}".split()
    with replace_file(path) as temporary:
        # Not imageio's writer: it forks, which can deadlock beside JAX's threads, and it hides the encoder's errors.
        # An absolute path, because ffmpeg takes `a:b.mp4` for a protocol and `-a.mp4` for an option.
        command = [find_ffmpeg(), *options, str(temporary.absolute())]
        pipe = subprocess.PIPE
        with subprocess.Popen(command, stdin=pipe, stdout=subprocess.DEVNULL, stderr=pipe) as encoder:
            try:
                count = _write_frames(encoder.stdin, frames)
                errors = encoder.stderr.read() if encoder.stderr else b""
            except BaseException:
                encoder.kill()
                raise
        if encoder.returncode != 0:
            *_, reason = [f"status {encoder.returncode}", *errors.decode(errors="replace").splitlines()]
            raise FilmError(f"cannot write {path}: the encoder stopped ({reason}); free space on the disk")
    return count


def _write_frames(pipe: IO[bytes] | None, frames: Iterable[np.ndarray]) -> int:
    """Writes all frames into `pipe` and returns their number. Stops early if the reader has closed the pipe."""
    assert pipe is not None  # Popen opens it for stdin=PIPE
    count = 0
    with contextlib.suppress(BrokenPipeError), pipe:
        for frame in frames:
            pipe.write(frame.tobytes())
            count += 1
    return count
