"""The time that a robot lives in. An emulated robot may have another than ours: its tests replace these two."""

from __future__ import annotations

import time


def now() -> float:
    """Seconds since some moment; on the clock that LeRobot's cameras date their pictures with."""
    return time.perf_counter()


def sleep(seconds: float) -> None:
    """Let the robot's time pass."""
    time.sleep(max(seconds, 0.0))
