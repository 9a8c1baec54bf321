"""Searchers that look for the view of a target image.

The black-box searchers `random_search`, `cma_es` and `cma_es_restarts` share one signature:

    search(key, score_fn, args, config) -> SearchResult

`score_fn(view, args.task) -> f32[]` is the cosine similarity at a view, or -inf where the arm cannot reach it. `args`
is a `SearchArgs`. It holds the initial view, the elevation band, the threshold, and the task for `score_fn`. The image
of the initial view is the first evaluation. The searcher applies `jax.vmap` to `score_fn` over its samples. Callers
apply `jax.vmap` or `jax.lax.map` to `search` over trials. `method(config)` returns the searcher in parts (`Method`),
for callers that take the images themselves.

`sac` holds soft actor-critic. Its `search` has the signature above, with the environment's step function in place of
`score_fn`.

`BLACK_BOX`, `POLICIES` and `LABELS` are the table of searchers that evaluation and report read.
"""

from vsearch_jax.search import cma_es, cma_es_restarts, random_search, sac
from vsearch_jax.search.common import Method, ScoreFn, SearchArgs
from vsearch_jax.search.table import BLACK_BOX, LABELS, POLICIES

__all__ = [
    "BLACK_BOX",
    "LABELS",
    "POLICIES",
    "Method",
    "ScoreFn",
    "SearchArgs",
    "cma_es",
    "cma_es_restarts",
    "random_search",
    "sac",
]
