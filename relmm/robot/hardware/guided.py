"""The guided calibration: what a person does before each measurement, and what it measures."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from relmm.errors import ConfigError
from relmm.robot.hardware.body import LocobotBody
from relmm.robot.hardware.calibration import Calibration
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


def ask(what: str) -> None:
    """Say what to do, and wait until it is done.

    Raises:
        ConfigError: nobody is there.
    """
    try:
        input(f"{what}, then press Enter.\n")
    except EOFError:
        raise ConfigError("A calibration needs a person at the terminal, who presses Enter.") from None
