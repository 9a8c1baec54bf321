"""A whole run as one jitted function: encoder updates first, then policy iterations, in equal chunks."""

from vsearch_jax.training.encoder_stage import encoder_iteration, fill_pool
from vsearch_jax.training.metrics import ENCODER_METRICS, ENCODER_STAGE, POLICY_METRICS, POLICY_STAGE, Metrics
from vsearch_jax.training.policy_stage import transition_of
from vsearch_jax.training.run import init, train, with_encoder

__all__ = [
    "ENCODER_METRICS",
    "ENCODER_STAGE",
    "POLICY_METRICS",
    "POLICY_STAGE",
    "Metrics",
    "encoder_iteration",
    "fill_pool",
    "init",
    "train",
    "transition_of",
    "with_encoder",
]
