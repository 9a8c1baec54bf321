"""Films one search by a trained policy.

`make_film` is imported when it is first used, since it needs JAX.
"""

from typing import TYPE_CHECKING

from vsearch_jax.film.writer import FilmError

if TYPE_CHECKING:
    from vsearch_jax.film.video import make_film

__all__ = ["FilmError", "make_film"]


def __getattr__(name: str) -> object:
    if name != "make_film":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from vsearch_jax.film.video import make_film

    return make_film
