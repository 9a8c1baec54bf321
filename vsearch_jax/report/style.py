"""Colours and matplotlib style of all figures."""

from __future__ import annotations

import matplotlib as mpl

COLORS = {
    "random_search": "#3b6fb6",
    "cma_es": "#d1812c",
    "cma_es_restarts": "#a8481f",
    "sac": "#2e8b6f",
    "sac_assisted": "#76a92c",
}
"""Colour of each searcher."""
THESIS_COLOR = "#8a8f98"
INK = "#23272e"
REACHABLE, UNREACHABLE = "#cfe6dc", "#f0c9c3"

styled = mpl.rc_context(
    {
        "figure.dpi": 110,
        "savefig.dpi": 150,
        "savefig.bbox": "tight",
        "figure.constrained_layout.use": True,
        "font.size": 10,
        "axes.titlesize": 11,
        "axes.titlelocation": "left",
        "axes.labelcolor": INK,
        "axes.edgecolor": "#9aa0a8",
        "axes.spines.top": False,
        "axes.spines.right": False,
        "axes.grid": True,
        "axes.axisbelow": True,
        "grid.color": "#e6e8eb",
        "grid.linewidth": 0.8,
        "legend.frameon": False,
        "legend.fontsize": 9,
        "lines.linewidth": 1.6,
        "text.color": INK,
        "xtick.color": INK,
        "ytick.color": INK,
    }
)
"""Decorator for functions that draw or save a figure: applies the style."""
