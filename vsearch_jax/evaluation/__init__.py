"""Evaluates every searcher by the thesis's protocol (chapters 3.6 to 4.3) in one jitted function of batched trials."""

from vsearch_jax.env import FALSE_POSITIVE_DEG, protocol_target
from vsearch_jax.evaluation.outcome import Outcome
from vsearch_jax.evaluation.protocol import check_target, evaluate
from vsearch_jax.evaluation.recording import record_search
from vsearch_jax.evaluation.views import initial_views

__all__ = [
    "FALSE_POSITIVE_DEG",
    "Outcome",
    "check_target",
    "evaluate",
    "initial_views",
    "protocol_target",
    "record_search",
]
