"""Processors of `relmm_paper`."""

from __future__ import annotations

from typing import Any

from lerobot.processor import PolicyProcessorPipeline

from relmm.policies.controller import make_identity_processors
from relmm.policies.relmm_paper.configuration_relmm_paper import RelmmPaperConfig


def make_relmm_paper_pre_post_processors(
    config: RelmmPaperConfig, dataset_stats: dict[str, Any] | None = None
) -> tuple[PolicyProcessorPipeline, PolicyProcessorPipeline]:
    """LeRobot's standard steps; the networks scale pictures themselves."""
    return make_identity_processors(config, dataset_stats)
