"""Processors of `relmm_scripted`."""

from typing import Any

from lerobot.processor import PolicyProcessorPipeline

from relmm.policies.controller import make_identity_processors
from relmm.policies.scripted.configuration_scripted import RelmmScriptedConfig


def make_relmm_scripted_pre_post_processors(
    config: RelmmScriptedConfig, dataset_stats: dict[str, Any] | None = None
) -> tuple[PolicyProcessorPipeline, PolicyProcessorPipeline]:
    """LeRobot's standard steps; nothing is normalised."""
    return make_identity_processors(config, dataset_stats)
