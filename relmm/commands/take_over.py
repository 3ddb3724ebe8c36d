"""A person who takes over while a robot learns."""

from __future__ import annotations

from collections.abc import Callable

from relmm.robot.locobot import LocobotRobot
from relmm.teleoperator.locobot_keyboard import HELP, TAKE_OVER, LocobotKeyboard

_POLL_S = 0.1  # between looks at the keyboard
_WATCH_S = 0.02  # on the robot's clock, for its body to be watched between two of them


class TakeOver:
    """Asked after every frame what a person wants to do next, and waits for their keys once they have taken over.

    Args:
        robot: connected.
        keyboard: connected.
        stopped: whether there was a signal.
        say: tells the person.
    """

    def __init__(
        self, robot: LocobotRobot, keyboard: LocobotKeyboard, stopped: Callable[[], bool], say: Callable[[str], None]
    ) -> None:
        self._robot, self._keyboard, self._stopped, self._say = robot, keyboard, stopped, say
        self._driving = False

    def __call__(self) -> dict[str, float] | None:
        """Their next action; None if nobody has taken over, or when they give back."""
        while self._keyboard.taken_over and not self._stopped():
            if not self._driving:
                self._driving = True
                self._say(f"You have taken over: {HELP}. {TAKE_OVER} gives back.")
            if (action := self._keyboard.next_action()) is not None:
                self._robot.skills.forget_picture()  # they may have moved things
                return action
            self._keyboard.wait(_POLL_S)
            self._robot.body.wait(_WATCH_S)
        if self._driving:
            self._driving = False
            self._say("The robot goes on by itself.")
            self._robot.skills.forget_picture()
        return None
