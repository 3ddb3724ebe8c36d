"""A policy that acts on a robot's observations, through its processors."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from lerobot.policies.pretrained import PreTrainedPolicy
from lerobot.processor import PolicyProcessorPipeline

from relmm.features import ACTION_NAMES, DEPTH_KEY, FRONT, FRONT_DEPTH, IMAGE_KEY, STATE_KEY, STATE_NAMES

TASK = "Pick up all objects and put them into the basket."


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

    @property
    def grasp_probability(self) -> float:
        """P[grasp] of the last decision, or -1 if the policy does not estimate it."""
        return float(getattr(self.policy, "grasp_probability", -1.0))


def to_batch(observation: dict[str, Any]) -> dict[str, Any]:
    """A robot's flat observation as LeRobot's policies take it: channels first, 0..1, a batch of one."""
    batch: dict[str, Any] = {
        IMAGE_KEY: torch.from_numpy(observation[FRONT]).permute(2, 0, 1)[None] / 255,
        STATE_KEY: torch.tensor([[observation[name] for name in STATE_NAMES]]),
        "task": [TASK],
    }
    if FRONT_DEPTH in observation:
        batch[DEPTH_KEY] = torch.from_numpy(observation[FRONT_DEPTH].astype("float32")).permute(2, 0, 1)[None]
    return batch
