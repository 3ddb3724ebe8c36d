"""Processors of `relmm_single`."""

from __future__ import annotations

from typing import Any

from lerobot.processor import PolicyProcessorPipeline

from relmm.policies.controller import make_identity_processors
from relmm.policies.relmm_single.configuration_relmm_single import RelmmSingleConfig


def make_relmm_single_pre_post_processors(
    config: RelmmSingleConfig, dataset_stats: dict[str, Any] | None = None
) -> tuple[PolicyProcessorPipeline, PolicyProcessorPipeline]:
    """LeRobot's standard steps; the networks scale pictures themselves."""
    return make_identity_processors(config, dataset_stats)
