"""A person at a keyboard as a LeRobot `Teleoperator`: one key, one skill of the LoCoBot."""

from __future__ import annotations

import threading
from typing import Any

from lerobot.teleoperators.utils import TeleopEvents
from lerobot.utils.keyboard_input import create_key_listener

from relmm.errors import RobotError
from relmm.features import (
    BASKET_XY,
    GRASP_X,
    GRASP_Y,
    MAX_THETA_VEL,
    MAX_X_VEL,
    Skill,
    action_dict,
)
from relmm.teleoperator.config_locobot_keyboard import LocobotKeyboardConfig
from relmm.teleoperator.locobot_teleoperator import LocobotTeleoperator

TAKE_OVER = "t"
HELP = (
    "w drives forward, a and d turn, capitals a quarter as far; 1 to 9 pick up or put down before the robot, placed as "
    "on a numeric keypad, and 0 drops into the basket"
)
# Shares of a full navigation step. Arrows would end episodes of lerobot-record.
_DRIVES = {"w": (1.0, 0.0), "a": (0.0, 1.0), "d": (0.0, -1.0), "W": (0.25, 0.0), "A": (0.0, 0.25), "D": (0.0, -0.25)}
_ROWS, _COLUMNS = 3, 3  # as on a numeric keypad: 7 is far and left


class LocobotKeyboard(LocobotTeleoperator):
    """Keys are read from the terminal, or on a desktop with X11 from anywhere, by LeRobot's own listener.

    Of keys that come while a skill runs, the last one counts.
    """

    config_class = LocobotKeyboardConfig
    name = "locobot_keyboard"

    def __init__(self, config: LocobotKeyboardConfig) -> None:
        super().__init__(config)
        self.config = config
        self._listener: Any = None
        self._key: str | None = None
        self._pressed = threading.Event()
        self.taken_over = False

    @property
    def is_connected(self) -> bool:
        """Whether it listens."""
        return self._listener is not None

    def connect(self, calibrate: bool = True) -> None:
        """Begin to listen.

        Raises:
            RobotError: there is no keyboard.
        """
        self._listener = create_key_listener(self._press, controls_help=HELP)
        if self._listener is None:
            raise RobotError(
                "locobot_keyboard needs a keyboard: start the command in a terminal, its input not redirected."
            )

    def _press(self, key: str) -> None:
        if key == TAKE_OVER:
            self.taken_over = not self.taken_over
        elif key in _DRIVES or key.isdecimal():
            self._key = key
        else:
            return
        self._pressed.set()

    def wait(self, seconds: float) -> None:
        """Until a key is pressed, at most so long."""
        self._pressed.wait(seconds)
        self._pressed.clear()

    def next_action(self) -> dict[str, float] | None:
        """What the last key asks for, None if there was none.

        Raises:
            RobotError: not exactly one LoCoBot is connected in this process.
        """
        key, self._key = self._key, None
        if key is None:
            return None
        if key in _DRIVES:
            forward, left = _DRIVES[key]
            return action_dict(x_vel=forward * MAX_X_VEL, theta_vel=left * MAX_THETA_VEL)
        if key == "0":
            return action_dict(Skill.PLACE, x=BASKET_XY[0], y=BASKET_XY[1])
        x, y = keypad_place(int(key))
        return action_dict(Skill.PLACE if self.robot().skills.holding else Skill.GRASP, x=x, y=y)

    def get_action(self) -> dict[str, float]:
        """What the last key asks for; without one the robot stands still for a navigation step.

        Raises:
            RobotError: not connected; or as `next_action`.
        """
        if self._listener is None:
            raise RobotError(f"{self} is not connected: call connect() first.")
        return self.next_action() or action_dict()

    def get_teleop_events(self) -> dict[TeleopEvents, bool]:
        """LeRobot's events: whether the person has taken over."""
        return {**dict.fromkeys(TeleopEvents, False), TeleopEvents.IS_INTERVENTION: self.taken_over}

    def disconnect(self) -> None:
        """Leave the keyboard to others."""
        if self._listener is not None:
            self._listener.stop()
            self._listener = None


def keypad_place(digit: int) -> tuple[float, float]:
    """The place (m, robot frame) in the grasp area that 1 to 9 stand for."""
    row, column = divmod(digit - 1, _COLUMNS)
    x = GRASP_X[0] + (row + 0.5) * (GRASP_X[1] - GRASP_X[0]) / _ROWS
    y = GRASP_Y[1] - (column + 0.5) * (GRASP_Y[1] - GRASP_Y[0]) / _COLUMNS
    return x, y
