"""Where a Kobuki has driven, by its wheels and its gyro."""

from __future__ import annotations

import math

from relmm.robot.hardware.kobuki_protocol import M_PER_TICK, WHEELBASE, Feedback

_TURN = 65_536  # at which encoders wrap
_FARTHEST = 0.5  # m, more than a wheel rolls between two readings; the check sum lets every 40th damaged frame through


class Odometry:
    """Adds up encoder ticks and gyro angles, which wrap.

    The gyro tells how far the base has turned while it drives: wheels slip. While it stands, the wheels tell, which do
    not drift, and which move when something pushes the base.

    Args:
        wheel_scale: true distance by the one that the encoders tell, from the calibration.

    Attributes:
        travelled: m since the first feedback; backwards counts negative.
        heading: degrees since then, positive = left, not wrapped.
    """

    def __init__(self, wheel_scale: float = 1.0) -> None:
        self._m_per_tick = M_PER_TICK * wheel_scale
        self._last: Feedback | None = None
        self.travelled = 0.0
        self.heading = 0.0

    def update(self, feedback: Feedback, driving: bool) -> None:
        """Take in one reading of the base; `driving` if it is told to move, or was a moment ago."""
        last, self._last = self._last, feedback
        if last is None:
            return
        left, right = (
            wrapped(now - before, _TURN) * self._m_per_tick
            for now, before in ((feedback.left, last.left), (feedback.right, last.right))
        )
        if max(abs(left), abs(right)) > _FARTHEST:
            self.forget_position()
            return
        self.travelled += (left + right) / 2
        if driving and feedback.angle is not None and last.angle is not None:
            self.heading += wrapped(feedback.angle - last.angle, 360.0)
        else:
            self.heading += math.degrees((right - left) / WHEELBASE)

    def forget_position(self) -> None:
        """Go on from the next reading: the base was switched off and its counters begin anew, or a reading is wrong."""
        self._last = None


def wrapped(difference: float, turn: float) -> float:
    """The smallest difference that a counter which wraps at `turn` may mean."""
    return (difference + turn / 2) % turn - turn / 2
