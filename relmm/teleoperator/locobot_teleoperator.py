"""What both of relmm's teleoperators are to LeRobot: five numbers an action, no feedback, nothing to calibrate."""

from __future__ import annotations

from typing import Any

from lerobot.teleoperators.teleoperator import Teleoperator

from relmm.errors import RobotError
from relmm.features import ACTION_NAMES
from relmm.robot.locobot import LocobotRobot


class LocobotTeleoperator(Teleoperator):
    """Acts for the LoCoBot that is connected in this process."""

    @property
    def action_features(self) -> dict[str, Any]:
        """The robot's."""
        return dict.fromkeys(ACTION_NAMES, float)

    @property
    def feedback_features(self) -> dict[str, Any]:
        """None."""
        return {}

    @property
    def is_calibrated(self) -> bool:
        """Always."""
        return True

    def calibrate(self) -> None:
        """Nothing to do."""

    def configure(self) -> None:
        """Nothing to do."""

    def send_feedback(self, feedback: dict[str, Any]) -> None:
        """Nothing to do."""

    def robot(self) -> LocobotRobot:
        """The LoCoBot.

        Raises:
            RobotError: none is connected in this process, or several are.
        """
        robots = LocobotRobot.connected()
        if len(robots) != 1:
            raise RobotError(
                f"{self.name} needs exactly one connected LoCoBot in this process, but there are {len(robots)}: "
                "use it with --robot.type=locobot or locobot_sim."
            )
        return robots[0]
