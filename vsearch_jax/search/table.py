"""The table of searchers. All other code that lists searchers reads it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from vsearch_jax.config import Config
from vsearch_jax.search import cma_es, cma_es_restarts, random_search
from vsearch_jax.search.common import Method

BLACK_BOX: dict[str, Callable[[Config], Method[Any]]] = {  # each searcher has its own type of state
    "random_search": lambda config: random_search.method(config.random_search),
    "cma_es": lambda config: cma_es.method(config.cma_es),
    "cma_es_restarts": lambda config: cma_es_restarts.method(config.cma_es),
}
"""Black-box searchers: {key in `results.json`: function from the run's config to the searcher in parts}."""

POLICIES: dict[str, bool] = {"sac": False, "sac_assisted": True}
"""Searches by a policy: {key in `results.json`: whether a local search helps}."""

LABELS = {
    "random_search": "Random search",
    "cma_es": "CMA-ES",
    "cma_es_restarts": "CMA-ES with scans and restarts",
    "sac": "SAC policy alone",
    "sac_assisted": "SAC with local search",
}
"""Display name of each searcher, by its key in `results.json`."""
