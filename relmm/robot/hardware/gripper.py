"""The gripper: a crank that moves both fingers, driven by a voltage, because its motor cannot measure force.

Source: `interbotix_xs_modules` (BSD-3): the crank, and PWM between 150 and 350.
"""

from __future__ import annotations

import math

_CRANK, _ROD = 0.014, 0.024  # m
_CLOSED_FINGERS = 0.030  # m, between the fingers' carriages when the pads touch
_MOVE_PWM, _HOLD_PWM = 250, 150  # of 885; what holds does not heat the motor
_STALL_S, _STALL_WAY = 0.25, 0.0004  # s and m: fingers that move less are stopped by something
_ARRIVED = 0.0015  # m


def opening_of(radians: float) -> float:
    """Between the finger pads, m, for an angle of the motor."""
    finger = _CRANK * math.sin(radians) + math.sqrt(_ROD**2 - (_CRANK * math.cos(radians)) ** 2)
    return 2 * finger - _CLOSED_FINGERS


class GripperControl:
    """Says from look to look which voltage moves the fingers to an opening, and notices what stops them.

    Attributes:
        obstructed: whether something stopped the fingers before they were there.
    """

    def __init__(self) -> None:
        self._goal: float | None = None
        self._closing = False
        self._seen = (0.0, 0.0)  # opening and time at which the fingers were seen to move
        self._holds = False
        self.obstructed = False

    def move(self, goal: float, opening: float, now: float) -> None:
        """Set out from an opening to another one (m); below 0 squeezes."""
        self._goal, self._closing = goal, goal < opening
        self._seen, self._holds, self.obstructed = (opening, now), False, False

    def pwm(self, opening: float, now: float) -> int:
        """What to apply now: 0 to 885, positive opens.

        Args:
            opening: m, as it is.
            now: s.
        """
        if self._goal is None:
            return 0
        if abs(opening - self._seen[0]) > _STALL_WAY:
            self._seen = (opening, now)
        arrived = opening <= self._goal + _ARRIVED if self._closing else opening >= self._goal - _ARRIVED
        if not self._holds and (arrived or now - self._seen[1] > _STALL_S):
            self._holds, self.obstructed = True, not arrived
        strength = _MOVE_PWM if not self._holds else _HOLD_PWM if self._goal < 0 else 0
        return -strength if self._closing else strength
