"""What a LoCoBot's body can do, simulated or real. Everything above this interface is written once."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from relmm.features import FloatArray
from relmm.geometry import CameraGeometry

MAX_OPENING = 0.044  # m, between the finger pads
BUMPER_RIGHT, BUMPER_CENTRE, BUMPER_LEFT = 1, 2, 4  # as the Kobuki reports them


@dataclass(frozen=True)
class BodyState:
    """One reading of the body's own sensors.

    Attributes:
        time: s since the body was started.
        travelled: m driven since then, from the wheel encoders; backwards counts negative.
        heading: degrees turned since then, from the wheel encoders; not wrapped.
        joints: rad, shape (5,).
        joint_goal: rad, where the joint servos are asked to be at this moment, shape (5,).
        gripper: m, opening between the finger pads.
        bumper: sum of the `BUMPER_` bits that were pressed at any time during the last `wait`.
    """

    time: float
    travelled: float
    heading: float
    joints: FloatArray
    joint_goal: FloatArray
    gripper: float
    bumper: int


class Body(Protocol):
    """The interface between what the LoCoBot does and the thing that does it.

    Commands return at once and last until the next one; `wait` lets them happen.
    """

    camera: CameraGeometry

    def drive(self, x_vel: float, theta_vel: float) -> None:
        """Drive at a speed (m/s) and a turn rate (deg/s, positive = left), approached with limited acceleration."""

    def move_arm(self, joints: FloatArray, seconds: float) -> None:
        """Move the five joints (rad) to a goal on a smooth profile of that duration."""

    def set_gripper(self, opening: float) -> None:
        """Move the fingers towards an opening (m) with limited force; below 0 squeezes."""

    def state(self) -> BodyState:
        """Read the sensors."""

    def capture(self) -> tuple[NDArray[np.uint8], NDArray[np.uint16]]:
        """Colour (height, width, 3) and depth along the optical axis (height, width) in mm, 0 = not measured."""

    def wait(self, seconds: float) -> None:
        """Let time pass."""

    def stop(self) -> None:
        """Stop the wheels now, and hold the arm where it is."""

    def close(self) -> None:
        """Stop, and release what the body holds."""
