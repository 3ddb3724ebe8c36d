"""Making the robot of a command."""

from __future__ import annotations

from lerobot.robots.config import RobotConfig

from relmm.commands.policies import take_seed
from relmm.errors import ConfigError
from relmm.robot.locobot import LocobotRobot


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
