"""Searchers that look for the view of a target image.

The black-box searchers `random_search` and `cma_es` share one signature:

    search(key, score_fn, args, config) -> SearchResult

`score_fn(view, args.task) -> f32[]` is the cosine similarity at a view, or -inf where the arm cannot reach it. `args`
is a `SearchArgs`. It holds the initial view, the elevation band, the threshold, and the task for `score_fn`. The image
of the initial view is the first evaluation. The searcher applies `jax.vmap` to `score_fn` over its samples. Callers
apply `jax.vmap` or `jax.lax.map` to `search` over trials. `method(config)` returns the searcher in parts (`Method`),
for callers that take the images themselves.

`sac` holds soft actor-critic. Its `search` has the signature above, with the environment's step function in place of
`score_fn`.
"""

from vsearch_jax.search import cma_es, random_search, sac
from vsearch_jax.search.common import Method, ScoreFn, SearchArgs

__all__ = ["Method", "ScoreFn", "SearchArgs", "cma_es", "random_search", "sac"]
