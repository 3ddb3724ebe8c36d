"""relmm-calibrate: measure what is particular to one LoCoBot, and keep it where LeRobot keeps calibrations."""

from __future__ import annotations

from dataclasses import dataclass, field

from lerobot.robots.config import RobotConfig

from relmm.commands.cli import run
from relmm.commands.robots import make_locobot
from relmm.errors import ConfigError, suggestion
from relmm.robot.hardware.guided import STEPS
from relmm.robot.hardware.locobot import Locobot


@dataclass
class CalibrateConfig:
    """Measure a LoCoBot.

    Args:
        robot: `--robot.type=locobot`.
        steps: which measurements, [camera,gripper,arm,wheels,grasp]; later ones use what earlier ones found.
    """

    robot: RobotConfig
    steps: list[str] = field(default_factory=lambda: list(STEPS))

    def __post_init__(self) -> None:
        for step in self.steps:
            if step not in STEPS:
                raise ConfigError(
                    f"There is no step {step!r}{suggestion(step, STEPS)}: choose from {', '.join(STEPS)}."
                )


def calibrate(config: CalibrateConfig) -> None:
    """Go through the steps; what a step has found is saved before the next one."""
    robot = make_locobot(config.robot, 0, "relmm-calibrate")
    if not isinstance(robot, Locobot):
        raise ConfigError(f"robot.type is {config.robot.type!r}, which needs no calibration: say --robot.type=locobot.")
    robot.measure(config.steps)


def main() -> None:
    """Entry point of `relmm-calibrate`."""
    run("relmm-calibrate", CalibrateConfig, calibrate)


if __name__ == "__main__":
    main()
