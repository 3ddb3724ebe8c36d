"""Making a policy and its processors from a command's config."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import draccus
from lerobot.configs import parser
from lerobot.configs.policies import PreTrainedConfig

from relmm.commands.arguments import said
from relmm.commands.cli import own_error
from relmm.errors import ConfigError
from relmm.features import dataset_features
from relmm.learning.actor import Actor
from relmm.learning.hub import fetch_policy
from relmm.learning.untrusted import WEIGHTS, check_features, check_policy_folder, check_weights
from relmm.policies.controller import ControllerConfig


def policy_from_path(policy: PreTrainedConfig | None) -> PreTrainedConfig:
    """The policy's config: as parsed from `--policy.type`, or from `--policy.path` with overrides, as LeRobot does it.

    Raises:
        ConfigError: neither was given, or there is no policy at the path.
    """
    _check_device(said().get("policy.device"))
    path = parser.get_path_arg("policy")
    if path:
        policy = load_config(path, parser.get_yaml_overrides("policy") + (parser.get_cli_overrides("policy") or []))
    if policy is None:
        raise ConfigError("No policy was given: say --policy.type=relmm_scripted, or --policy.path=FOLDER_OR_REPO.")
    return _on_this_machine(policy)


def load_config(path: str, overrides: list[str]) -> PreTrainedConfig:
    """The config of a policy in a folder or on the Hub, ready for `make_actor`.

    Args:
        path: a folder, or user/repo[@revision].
        overrides: of its settings, as on the command line, without the name of the policy.

    Raises:
        ConfigError: there is no policy.
    """
    folder = fetch_policy(path)
    try:
        policy = PreTrainedConfig.from_pretrained(folder, cli_overrides=overrides)
    except (OSError, ValueError, draccus.utils.DraccusException) as error:
        raise own_error(error) or ConfigError(
            f"No policy can be loaded from {path!r} ({' '.join(str(error).split())}): use another checkpoint, or "
            "the version of relmm that wrote it."
        ) from error
    policy.pretrained_path = folder
    check_features(policy, folder)
    _forget_owner(policy, overrides)
    return _on_this_machine(policy)


def _on_this_machine(policy: PreTrainedConfig) -> PreTrainedConfig:
    """A file's device, which LeRobot takes for one of this machine if it begins with cuda."""
    if policy.device not in _devices():
        policy.device = _devices()[-1]
    return policy


def _forget_owner(policy: PreTrainedConfig, overrides: list[str]) -> None:
    """Where a policy was uploaded to is not where this run uploads to."""
    for name, value in (("push_to_hub", False), ("repo_id", None), ("private", None)):
        if not any(override.startswith(f"--{name}=") for override in overrides):
            setattr(policy, name, value)


def check_camera(policy: PreTrainedConfig, option: str, seen_through: Any) -> None:
    """Refuse a policy that takes the pictures for those of another camera.

    Args:
        policy: its config.
        option: that the camera is named by.
        seen_through: config of a robot or room.

    Raises:
        ConfigError: with both cameras.
    """
    camera = getattr(seen_through, "camera", None)
    expected = getattr(policy, "camera", camera)
    if None not in (camera, expected) and camera != expected:
        raise ConfigError(
            f"{option} is {camera!r} but policy.camera is {expected!r}: the policy must know the camera that it sees "
            f"through; say --{option}={expected}, or --policy.camera={camera} if it has not learned with another."
        )


class FreshWeights:
    """Lets an actor take over the weights of newer checkpoints, while another process trains; damaged ones are refused.

    Args:
        actor: loaded from `path`.
        path: its folder; when it leads through a link such as `checkpoints/last`, that may come to point elsewhere.
    """

    def __init__(self, actor: Actor, path: Path | None) -> None:
        self._actor, self._path = actor, path
        self._loaded = self._newest()

    @property
    def step(self) -> int:
        """Navigation steps of the learner when it saved these weights; -1 where their folder does not tell."""
        name = "" if self._loaded is None else self._loaded[0].parent.name
        return int(name) if name.isdecimal() else -1

    def take(self) -> Path | None:
        """Load what is newer than the last time; the folder it is in, None if there is nothing."""
        newest = self._newest()
        if newest is None or newest == self._loaded:
            return None
        from safetensors import SafetensorError
        from safetensors.torch import load_model

        folder, _ = newest
        try:
            check_policy_folder(folder)
            check_weights(self._actor.policy.config, folder)
            load_model(self._actor.policy, folder / WEIGHTS)
        except (ConfigError, OSError, SafetensorError):
            if self._newest() == newest:
                raise
            return None  # replaced while it was read
        self._loaded = newest
        return folder

    def _newest(self) -> tuple[Path, int] | None:
        """The folder, and which file of weights is in it: those of one step may be saved again."""
        if self._path is None:
            return None
        folder = self._path.resolve()
        try:
            return folder, (folder / WEIGHTS).stat().st_ino
        except FileNotFoundError:
            return None


def _check_device(asked: str | None) -> None:
    """Refuse a device that was asked for and is not there; LeRobot would quietly take another one."""
    if asked is not None and asked not in _devices():
        raise ConfigError(f"policy.device is {asked!r}, which this machine does not have: say --policy.device=cpu.")


def _devices() -> list[str]:
    """Those of this machine; the last one is the best."""
    import torch

    there = ["cpu", *(f"cuda:{index}" for index in range(torch.cuda.device_count()))]
    return there + ["mps"] * torch.backends.mps.is_available() + ["cuda"] * torch.cuda.is_available()


def take_seed(config: Any, seed: int) -> None:
    """Give a robot or policy the command's seed, unless it has its own."""
    if getattr(config, "seed", 0) is None:
        config.seed = seed


def make_actor(config: PreTrainedConfig) -> Actor:
    """The policy with its processors, ready to act on a LoCoBot.

    Raises:
        ConfigError: a policy of others that has learned nothing, or cannot be loaded; or one of relmm's that does not
            fit its config.
    """
    from lerobot.policies.factory import get_policy_class, make_pre_post_processors
    from lerobot.utils.feature_utils import dataset_to_policy_features

    features = dataset_to_policy_features(dataset_features())
    if not config.input_features:
        config.input_features = {key: value for key, value in features.items() if key != "action"}
    config.output_features = {"action": features["action"]}
    path, own = config.pretrained_path, isinstance(config, ControllerConfig)
    if path is None and not own:
        raise ConfigError(f"A policy {config.type} has to learn first: say --policy.path=FOLDER_OR_REPO.")
    if path is None:
        return Actor(get_policy_class(config.type)(config=config), *make_pre_post_processors(config))
    if own:
        check_policy_folder(Path(path))
        check_weights(config, Path(path))
        policy = get_policy_class(config.type).from_pretrained(path, config=config)
        # The stored processors say nothing that the config does not; nothing of theirs has to be trusted.
        return Actor(policy, *make_pre_post_processors(config))
    if hasattr(config, "pretrained_backbone_weights"):
        config.pretrained_backbone_weights = None  # those of the checkpoint replace them; LeRobot would download them
    # The processors were saved with the device of the machine that trained.
    device = {"device_processor": {"device": config.device}}
    try:
        policy = get_policy_class(config.type).from_pretrained(path, config=config)
        pre, post = make_pre_post_processors(config, pretrained_path=str(path), preprocessor_overrides=device)
    except (ImportError, LookupError, OSError, RuntimeError, ValueError) as error:
        raise own_error(error) or ConfigError(
            f"The policy {config.type} in {path} cannot be loaded ({' '.join(str(error).split())}): use another "
            "checkpoint, or install what it needs."
        ) from error
    return Actor(policy, pre, post)
