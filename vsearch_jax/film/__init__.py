"""One search by a trained policy as a video."""

from vsearch_jax.film.video import make_video
from vsearch_jax.film.writer import FilmError

__all__ = ["FilmError", "make_video"]
