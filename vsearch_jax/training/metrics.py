"""Names of the metrics that `train` returns, and the numbers of the stages."""

from __future__ import annotations

from typing import TypeAlias

from jax import Array

Metrics: TypeAlias = dict[str, Array]
"""Metrics by name, f32[] each."""

ENCODER_STAGE, POLICY_STAGE = 0, 1
ENCODER_METRICS = ("encoder_loss", "false_match_rate", "threshold_angle_deg")
UPDATE_METRICS = ("critic_loss", "value_loss", "actor_loss", "alpha", "entropy")
POLICY_METRICS = ("reward", "similarity", "success_rate", "pose_success_rate", "unreachable_rate", *UPDATE_METRICS)
