"""Making a policy and its processors from a command's config."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from lerobot.configs import parser
from lerobot.configs.policies import PreTrainedConfig

from relmm.errors import ConfigError
from relmm.features import dataset_features
from relmm.learning.actor import Actor


def policy_from_path(policy: PreTrainedConfig | None) -> PreTrainedConfig:
    """The policy's config: as parsed from `--policy.type`, or from `--policy.path` with overrides, as LeRobot does it.

    Raises:
        ConfigError: neither was given, or there is no policy at the path.
    """
    path = parser.get_path_arg("policy")
    if path:
        overrides = parser.get_yaml_overrides("policy") + (parser.get_cli_overrides("policy") or [])
        try:
            policy = PreTrainedConfig.from_pretrained(path, cli_overrides=overrides)
        except (OSError, ValueError) as error:
            raise ConfigError(
                f"No policy can be loaded from {path!r} ({' '.join(str(error).split())}): give the folder of a "
                "checkpoint's pretrained_model, or a repository user/name on the Hub."
            ) from error
        policy.pretrained_path = Path(path)
    if policy is None:
        raise ConfigError("No policy was given: say --policy.type=relmm_scripted, or --policy.path=FOLDER_OR_REPO.")
    return policy


def take_seed(config: Any, seed: int) -> None:
    """Give a robot or policy the command's seed, unless it has its own."""
    if getattr(config, "seed", 0) is None:
        config.seed = seed


def make_actor(config: PreTrainedConfig) -> Actor:
    """The policy with its processors, ready to act on a LoCoBot."""
    from lerobot.policies.factory import get_policy_class, make_pre_post_processors
    from lerobot.utils.feature_utils import dataset_to_policy_features

    features = dataset_to_policy_features(dataset_features())
    if not config.input_features:
        config.input_features = {key: value for key, value in features.items() if key != "action"}
    config.output_features = {"action": features["action"]}
    path = config.pretrained_path
    policy_class = get_policy_class(config.type)
    policy = policy_class.from_pretrained(path, config=config) if path else policy_class(config=config)
    pre, post = make_pre_post_processors(config, pretrained_path=str(path) if path else None)
    return Actor(policy, pre, post)
