"""Soft actor-critic with goal relabelling: networks, update, replay buffer, relabelling, and searches by a policy."""

from vsearch_jax.search.sac import assisted
from vsearch_jax.search.sac.agent import KnownActions, act, init, td_target, update
from vsearch_jax.search.sac.policy import PolicyTask, mean_action, search
from vsearch_jax.search.sac.pool_steps import IndexedPool, index_pool, sample_pool_steps
from vsearch_jax.search.sac.relabel import relabel
from vsearch_jax.search.sac.replay import init_replay, insert, sample_batch

__all__ = [
    "IndexedPool",
    "KnownActions",
    "PolicyTask",
    "act",
    "assisted",
    "index_pool",
    "init",
    "init_replay",
    "insert",
    "mean_action",
    "relabel",
    "sample_batch",
    "sample_pool_steps",
    "search",
    "td_target",
    "update",
]
