"""The thesis's protocol (thesis, chapters 3.6 to 4.3) for every searcher as one jitted function of batched trials."""

from vsearch_jax.evaluation.filming import FPS, MOST_SECONDS, FilmedSearch, Frames, film_search, look_along
from vsearch_jax.evaluation.outcome import FALSE_POSITIVE_DEG
from vsearch_jax.evaluation.overview import overview_camera
from vsearch_jax.evaluation.protocol import check_target, evaluate
from vsearch_jax.evaluation.recording import record_search
from vsearch_jax.evaluation.views import initial_views, protocol_target

__all__ = [
    "FALSE_POSITIVE_DEG",
    "FPS",
    "MOST_SECONDS",
    "FilmedSearch",
    "Frames",
    "check_target",
    "evaluate",
    "film_search",
    "initial_views",
    "look_along",
    "overview_camera",
    "protocol_target",
    "record_search",
]
