"""Processors of `relmm_random`."""

from typing import Any

from lerobot.processor import PolicyProcessorPipeline

from relmm.policies.controller import make_identity_processors
from relmm.policies.random.configuration_random import RelmmRandomConfig


def make_relmm_random_pre_post_processors(
    config: RelmmRandomConfig, dataset_stats: dict[str, Any] | None = None
) -> tuple[PolicyProcessorPipeline, PolicyProcessorPipeline]:
    """LeRobot's standard steps; nothing is normalised."""
    return make_identity_processors(config, dataset_stats)
