"""Results, table, figures and page of a run, each with the thesis's figures beside ours."""

from vsearch_jax.report.figures import mount_heights, reachability, search_strip
from vsearch_jax.report.film import FilmError, FilmPage, Moment, write_film
from vsearch_jax.report.page import draw, png, write
from vsearch_jax.report.summary import SEARCHERS, results
from vsearch_jax.report.table import print_table

__all__ = [
    "SEARCHERS",
    "FilmError",
    "FilmPage",
    "Moment",
    "draw",
    "mount_heights",
    "png",
    "print_table",
    "reachability",
    "results",
    "search_strip",
    "write",
    "write_film",
]
