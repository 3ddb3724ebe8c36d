"""relmm-calibrate: measure what is particular to one LoCoBot, and keep it where LeRobot keeps calibrations."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from lerobot.robots.config import RobotConfig

from relmm.commands.cli import run
from relmm.commands.robots import make_locobot
from relmm.errors import ConfigError, suggestion
from relmm.robot.hardware.body import LocobotBody
from relmm.robot.hardware.calibration import Calibration
from relmm.robot.hardware.locobot import Locobot
from relmm.robot.hardware.measuring import (
    measure_arm_delay,
    measure_camera,
    measure_grasp,
    measure_gripper,
    measure_sag,
    measure_wheels,
)


@dataclass(frozen=True)
class Step:
    """One measurement.

    Attributes:
        prepare: what a person does before it.
        measure: gives the values that replace those of the calibration.
    """

    prepare: str
    measure: Callable[[LocobotBody, Calibration], dict[str, Any]]


def _measure_arm(body: LocobotBody, old: Calibration) -> dict[str, Any]:
    return {**measure_arm_delay(body, old.arm_delay), **measure_sag(body, old.sag_array())}


STEPS = {
    "camera": Step(
        "Put the robot onto empty floor, 1 m free in front of it",
        lambda body, old: measure_camera(body, np.random.default_rng(0)),
    ),
    "gripper": Step(
        "See that nothing is between the fingers", lambda body, old: measure_gripper(body, old.closed_opening)
    ),
    "arm": Step(
        "Keep away from the arm: it moves fast, and stretches out over the floor",
        _measure_arm,
    ),
    "wheels": Step(
        "Put the robot 0.6 m in front of a wall, square to it: it drives 0.15 m towards it",
        lambda body, old: measure_wheels(body, old.wheel_scale),
    ),
    "grasp": Step(
        "Put the robot onto empty floor of one colour, and have a bright sticker of 1 to 2 cm ready",
        lambda body, old: measure_grasp(body, ask, np.array(old.grasp)),
    ),
}


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
    for number, name in enumerate(config.steps, 1):
        step = STEPS[name]
        ask(f"{number}/{len(config.steps)} {name}. {step.prepare}")
        with robot:
            values = step.measure(robot.body, robot.measured)
        robot.take_measured(replace(robot.measured, **values))
        print(f"  {', '.join(f'{key} = {value}' for key, value in values.items())}")
    print(f"saved in {robot.calibration_fpath}")


def ask(what: str) -> None:
    """Say what to do, and wait until it is done.

    Raises:
        ConfigError: nobody is there.
    """
    try:
        input(f"{what}, then press Enter.\n")
    except EOFError:
        raise ConfigError("relmm-calibrate needs a person at the terminal, who presses Enter.") from None


def main() -> None:
    """Entry point of `relmm-calibrate`."""
    run("relmm-calibrate", CalibrateConfig, calibrate)


if __name__ == "__main__":
    main()
