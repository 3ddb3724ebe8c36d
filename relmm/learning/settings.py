"""The settings of a run, as its checkpoints keep them in `train_config.json`."""

from __future__ import annotations

import re
from dataclasses import fields
from pathlib import Path
from types import NoneType
from typing import Any

from lerobot.configs.policies import PreTrainedConfig

from relmm.errors import ConfigError
from relmm.learning.untrusted import read_json, refuse_first_version
from relmm.policies.learning import LearningConfig

SETTINGS = "train_config.json"
# What cards and uploads look at.
_SHAPE = {
    "policy": {"type": str, "camera": str},
    "dataset": {"root": str | None, "follow": str | None},
    "curriculum": {"type": str},
    "eval": {"seed": int},
    "seed": int,
}
_ROBOT = {"type": str}
# What means the same on every machine: nothing that names a file or a device.
_PORTABLE = {"curriculum", "eval", "steps", "seed", "env_eval_freq", "save_freq", "log_freq", "max_steps"}
_PORTABLE |= {"pseudo_reset_steps", "replay_frames"}
_PORTABLE_ROBOT = ("type", "room", "num_objects", "seed", "camera", "depth", "tidy_every", "realism")
_ON_THE_HUB = re.compile(r"[\w.-]+/[\w.-]+(@\w+)?")  # not a folder of another machine


def read_settings(model: Path) -> dict[str, Any]:
    """The settings of the run that a checkpoint is of.

    Args:
        model: its `pretrained_model`.

    Raises:
        ConfigError: there are none, or not those of relmm-train.
    """
    settings: dict[str, Any] = read_json(model / SETTINGS)
    robot, policy = (settings.get(name) if isinstance(settings, dict) else None for name in ("robot", "policy"))
    refuse_first_version(policy if isinstance(policy, dict) else {}, model / SETTINGS)
    if not _fits(settings, _SHAPE) or (not isinstance(robot, NoneType) and not _fits(robot, _ROBOT)):
        raise ConfigError(f"{model / SETTINGS} has not the settings of a run of relmm-train; use another checkpoint.")
    kind = PreTrainedConfig.get_known_choices().get(settings["policy"]["type"])
    if kind is None or not issubclass(kind, LearningConfig):
        raise ConfigError(f"{model / SETTINGS} is of no policy that relmm-train trains; use another checkpoint.")
    return settings


def _fits(data: Any, shape: Any) -> bool:
    if isinstance(shape, dict):
        return isinstance(data, dict) and all(key in data and _fits(data[key], shape[key]) for key in shape)
    return isinstance(data, shape)


def portable_settings(settings: Any) -> dict[str, Any]:
    """A run's settings without what belongs to one machine or person: folders, devices, and where it is uploaded to.

    Args:
        settings: content of a `train_config.json`, perhaps from elsewhere.

    Raises:
        ConfigError: it is none.
    """
    sections = [settings.get(name) if isinstance(settings, dict) else None for name in ("policy", "dataset", "robot")]
    policy, dataset, robot = sections
    if not isinstance(policy, dict) or not isinstance(dataset, dict) or not isinstance(robot, dict | None):
        raise ConfigError(f"{SETTINGS} has no settings of policy, dataset and robot; use another checkpoint.")
    # Other settings of the policy are checked when its config is made, which refuses those that it does not know.
    machine = {field.name for field in fields(PreTrainedConfig)} - {"license", "tags"} | {"path"}
    policy = {key: value for key, value in policy.items() if key not in machine}
    init = dataset.get("init")
    dataset = {key: dataset[key] for key in ("repo_id", "license") if key in dataset}
    dataset["init"] = init if isinstance(init, str) and _ON_THE_HUB.fullmatch(init) else None
    if robot is not None:
        robot = {key: robot[key] for key in _PORTABLE_ROBOT if key in robot}
    return {
        **{key: value for key, value in settings.items() if key in _PORTABLE},
        "policy": {**policy, "push_to_hub": False, "repo_id": None},
        "dataset": {**dataset, "push_to_hub": False},
        "robot": robot,
        "hub": {},
    }
