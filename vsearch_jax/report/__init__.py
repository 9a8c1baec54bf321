"""Report of a run: results.json, table, figures and HTML page. Each shows the thesis's values beside ours."""

from vsearch_jax.report.figures import draw_mount_heights, draw_reachability, draw_search_strip
from vsearch_jax.report.page import draw_figures, to_png, write_files, write_report
from vsearch_jax.report.provenance import provenance
from vsearch_jax.report.summary import false_positive_warning, summarize_results
from vsearch_jax.report.table import print_table

__all__ = [
    "draw_figures",
    "draw_mount_heights",
    "draw_reachability",
    "draw_search_strip",
    "false_positive_warning",
    "print_table",
    "provenance",
    "summarize_results",
    "to_png",
    "write_files",
    "write_report",
]
