"""Results, table, figures and page of a run, each with the thesis's figures beside ours."""

from vsearch_jax.report.figures import mount_heights, reachability, search_strip
from vsearch_jax.report.page import draw, to_png, write, write_report
from vsearch_jax.report.summary import SEARCHERS, results
from vsearch_jax.report.table import print_table

__all__ = [
    "SEARCHERS",
    "draw",
    "mount_heights",
    "print_table",
    "reachability",
    "results",
    "search_strip",
    "to_png",
    "write",
    "write_report",
]
