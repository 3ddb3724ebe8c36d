"""A policy that acts on a robot's observations, through its processors."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lerobot.policies.pretrained import PreTrainedPolicy
from lerobot.processor import PolicyProcessorPipeline
from numpy.typing import NDArray

from relmm.features import ACTION_NAMES, DEPTH_KEY, FRONT, FRONT_DEPTH, IMAGE_KEY, STATE_KEY, STATE_NAMES, TASK
from relmm.policies.controller import ControllerPolicy
from relmm.policies.pseudo_reset import random_pseudo_reset


class Actor:
    """Turns one robot's observation into its next action.

    Args:
        policy: any LeRobot policy with relmm's features.
        preprocessor, postprocessor: the policy's own.

    Attributes:
        policy: as given.
    """

    def __init__(
        self, policy: PreTrainedPolicy, preprocessor: PolicyProcessorPipeline, postprocessor: PolicyProcessorPipeline
    ) -> None:
        self.policy, self._preprocessor, self._postprocessor = policy, preprocessor, postprocessor
        policy.eval()

    def reset(self) -> None:
        """Begin a new episode."""
        self.policy.reset()

    def save_pretrained(self, folder: Path) -> None:
        """Write a folder that LeRobot's `--policy.path` takes."""
        for part in (self.policy, self._preprocessor, self._postprocessor):
            part.save_pretrained(folder)

    def act(self, observation: dict[str, Any]) -> dict[str, float]:
        """The next action by name, for a robot's flat observation."""
        batch = self._preprocessor(to_batch(observation))
        with torch.inference_mode():
            action = self._postprocessor(self.policy.select_action(batch))
        return dict(zip(ACTION_NAMES, action.squeeze(0).tolist(), strict=True))

    def watch(self, observation: dict[str, Any]) -> None:
        """Take in an observation that the policy does not decide on."""
        if isinstance(self.policy, ControllerPolicy):
            row = self.policy.row(0)
            self.policy.observe(observation[FRONT], state_vector(observation), row)
            row.observed = True

    def pseudo_reset(
        self, rng: np.random.Generator, steps: int, holding: Callable[[], bool]
    ) -> Iterator[dict[str, float]]:
        """The policy's own, or the paper's for a policy of somebody else; `watch` is to be called between actions."""
        if isinstance(self.policy, ControllerPolicy):
            return self.policy.pseudo_reset(self.policy.row(0), steps, holding)
        return random_pseudo_reset(rng, steps, holding)

    def describe(self, action: dict[str, float]) -> str:
        """What an action of the policy is for, in a few words for people; empty for a policy of somebody else."""
        return self.policy.describe(action, self.policy.row(0)) if isinstance(self.policy, ControllerPolicy) else ""

    def picture(self) -> NDArray[np.uint8] | None:
        """What the policy thinks, to look at; None for a policy that has nothing to show."""
        return self.policy.picture(self.policy.row(0)) if isinstance(self.policy, ControllerPolicy) else None

    @property
    def belief(self) -> dict[str, float]:
        """What the last decision was based on, by `relmm.features.BELIEF`; empty for a policy without an opinion."""
        return self.policy.row(0).belief if isinstance(self.policy, ControllerPolicy) else {}


def state_vector(observation: dict[str, Any]) -> NDArray[np.float32]:
    """A robot's flat observation as `observation.state`."""
    return np.array([observation[name] for name in STATE_NAMES], np.float32)


def to_batch(observation: dict[str, Any]) -> dict[str, Any]:
    """A robot's flat observation as LeRobot's policies take it: channels first, 0..1, a batch of one."""
    batch: dict[str, Any] = {
        IMAGE_KEY: torch.from_numpy(observation[FRONT]).permute(2, 0, 1)[None] / 255,
        STATE_KEY: torch.from_numpy(state_vector(observation))[None],
        "task": [TASK],
    }
    if FRONT_DEPTH in observation:
        batch[DEPTH_KEY] = torch.from_numpy(observation[FRONT_DEPTH].astype("float32")).permute(2, 0, 1)[None]
    return batch
