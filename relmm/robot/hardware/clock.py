"""The time that a robot lives in."""

from __future__ import annotations

import time

SPEED = 1.0  # of a robot's time against ours. Only an emulated robot may live faster.


def now() -> float:
    """s since some moment."""
    return time.monotonic() * SPEED


def sleep(seconds: float) -> None:
    """Let the robot's time pass."""
    time.sleep(max(seconds, 0.0) / SPEED)
