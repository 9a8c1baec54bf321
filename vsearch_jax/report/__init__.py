"""Results, table, figures and page of a run, each with the thesis's figures beside ours."""

from vsearch_jax.report.figures import search_strip
from vsearch_jax.report.page import draw, write
from vsearch_jax.report.summary import SEARCHERS, results
from vsearch_jax.report.table import print_table

__all__ = ["SEARCHERS", "draw", "print_table", "results", "search_strip", "write"]
