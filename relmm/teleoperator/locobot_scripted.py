"""The scripted controller as a LeRobot `Teleoperator`."""

from __future__ import annotations

import torch

from relmm.errors import RobotError
from relmm.features import (
    ACTION_NAMES,
    FRONT,
    IMAGE_KEY,
    STATE_KEY,
    STATE_NAMES,
)
from relmm.policies.scripted.configuration_scripted import RelmmScriptedConfig
from relmm.policies.scripted.modeling_scripted import RelmmScriptedPolicy
from relmm.teleoperator.config_locobot_scripted import LocobotScriptedConfig
from relmm.teleoperator.locobot_teleoperator import LocobotTeleoperator


class LocobotScripted(LocobotTeleoperator):
    """Looks through the eyes of the LoCoBot that is connected in this process, as a person beside it would."""

    config_class = LocobotScriptedConfig
    name = "locobot_scripted"

    def __init__(self, config: LocobotScriptedConfig) -> None:
        super().__init__(config)
        self.config = config
        self._policy: RelmmScriptedPolicy | None = None

    @property
    def is_connected(self) -> bool:
        """Whether `connect` was called."""
        return self._policy is not None

    def connect(self, calibrate: bool = True) -> None:
        """Start the controller."""
        self._policy = RelmmScriptedPolicy(
            RelmmScriptedConfig(camera=self.config.camera, seed=self.config.seed, device="cpu")
        )

    def get_action(self) -> dict[str, float]:
        """What the controller would do now.

        Raises:
            RobotError: not connected, or not exactly one LoCoBot is connected in this process.
        """
        if self._policy is None:
            raise RobotError(f"{self} is not connected: call connect() first.")
        observation = self.robot().get_observation()
        batch = {
            IMAGE_KEY: torch.from_numpy(observation[FRONT]).permute(2, 0, 1)[None] / 255,
            STATE_KEY: torch.tensor([[observation[name] for name in STATE_NAMES]]),
        }
        return dict(zip(ACTION_NAMES, self._policy.select_action(batch)[0].tolist(), strict=True))

    def disconnect(self) -> None:
        """Stop the controller."""
        self._policy = None
