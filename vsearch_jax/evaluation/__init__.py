"""The thesis's protocol (thesis, chapters 3.6 to 4.3) for every searcher as one jitted function of batched trials."""

from vsearch_jax.evaluation.outcome import FALSE_POSITIVE_DEG
from vsearch_jax.evaluation.protocol import check_target, evaluate
from vsearch_jax.evaluation.recording import record_search
from vsearch_jax.evaluation.views import initial_views, protocol_target

__all__ = [
    "FALSE_POSITIVE_DEG",
    "check_target",
    "evaluate",
    "initial_views",
    "protocol_target",
    "record_search",
]
