"""Making the robot of a command."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from lerobot.robots.config import RobotConfig

from relmm.commands.policies import take_seed
from relmm.errors import ConfigError
from relmm.robot.locobot import LocobotRobot
from relmm.sim.locobot_sim import LocobotSim
from relmm.sim.person import Person

_PERSON_STREAM = 4  # keeps random numbers of one seed apart


class Pause:
    """Asked after every frame whether to end the episode: on a signal, and when the battery is low.

    A low battery first ends the episode, which is saved then; when asked again, it waits for the charge.

    Args:
        robot: connected.
        stopped: whether there was a signal.
    """

    def __init__(self, robot: LocobotRobot, stopped: Callable[[], bool]) -> None:
        self._robot, self._stopped = robot, stopped
        self._low = False
        self.charged: Callable[[], None] = lambda: None  # called when the robot goes on

    def __call__(self) -> bool:
        """Whether to end the episode here."""
        if self._stopped():
            return True
        if self._low:
            self._robot.await_charge(self._stopped)
            self._low = False
            self.charged()
        self._low = self._robot.needs_charging
        return self._low or self._stopped()


def person_beside(robot: LocobotRobot, seed: int) -> Person | None:
    """Who helps a simulated robot; nobody helps a real one unasked."""
    return Person(robot, np.random.default_rng([seed, _PERSON_STREAM])) if isinstance(robot, LocobotSim) else None


def make_locobot(config: RobotConfig, seed: int, command: str) -> LocobotRobot:
    """The robot of a config, not connected yet.

    Args:
        config: of the robot; takes the seed unless it has its own.
        seed: of the command.
        command: its name, for messages.

    Raises:
        ConfigError: it is no LoCoBot.
    """
    from lerobot.robots.utils import make_robot_from_config

    take_seed(config, seed)
    robot = make_robot_from_config(config)
    if not isinstance(robot, LocobotRobot):
        raise ConfigError(f"{command} needs a LoCoBot, not {config.type!r}: say --robot.type=locobot_sim.")
    return robot
