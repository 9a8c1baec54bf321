"""Searchers for the view that shows what a target image shows.

The black-box searchers, `random_search` and `cma_es`, share one face:

    search(key, score_fn, args, config) -> SearchResult

`score_fn(view, args.task) -> f32[]` is the cosine similarity at a view, -inf where the arm can't reach it; `args` is a
`SearchArgs`: initial view, elevation band, threshold, and the task that `score_fn` gets. The searcher vmaps `score_fn`
over its samples; callers vmap or map `search` over trials. The image of the initial view is the first evaluation.
`method(config)` gives a searcher in parts, for callers that take the images themselves.

`sac` holds the policy. It keeps its own state between steps, so its `search` rolls out an environment's step function.
"""

from vsearch_jax.search import cma_es, random_search, sac
from vsearch_jax.search.common import Method, ScoreFn, SearchArgs

__all__ = ["Method", "ScoreFn", "SearchArgs", "cma_es", "random_search", "sac"]
