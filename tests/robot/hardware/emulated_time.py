"""The time of an emulated LoCoBot, shared by the process that emulates it and the one that drives it.

Either it runs by itself, at some speed against ours, or it passes only while the driving program sleeps: then neither a
busy machine nor a slow learner changes what happens, and an hour of the robot takes as long as its simulation.
"""

from __future__ import annotations

import mmap
import struct
import time
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace

_POLL_S = 0.0003
_STILL_S = 0.05  # of our time: the robot's stands still, and a camera goes on sending what it sees
# The SDK allows an answer 34 ms, and the driver its guard 5 s. On a busy machine both may take longer.
_PATIENCE_MS, _START_S = 5000, 60.0


class SharedTime:
    """Two numbers in a file: the robot's time, and until when it may pass.

    Args:
        path: of the file; made if it is not there.
    """

    def __init__(self, path: Path) -> None:
        if not path.exists():
            path.write_bytes(bytes(16))
        with path.open("r+b") as file:
            self._memory = mmap.mmap(file.fileno(), 16)

    def now(self) -> float:
        return struct.unpack_from("d", self._memory, 0)[0]

    def allowed(self) -> float:
        return struct.unpack_from("d", self._memory, 8)[0]

    # --- The emulator ------------------------------------------------------------------------------------
    def advance(self, seconds: float) -> None:
        struct.pack_into("d", self._memory, 0, self.now() + seconds)

    # --- The program that drives it ----------------------------------------------------------------------
    def sleep(self, seconds: float) -> None:
        until = self.now() + max(seconds, 0.0)
        struct.pack_into("d", self._memory, 8, max(until, self.allowed()))
        while self.now() < until - 1e-9:
            time.sleep(_POLL_S)


def live_in(shared: SharedTime, replace: Callable[[object, str, object], None] = setattr) -> None:
    """Let this process's driver of a LoCoBot live in an emulated time.

    Args:
        shared: that time.
        replace: `setattr`, or pytest's, which puts back what was there.
    """
    camera, fake = import_module("lerobot.cameras.realsense.camera_realsense"), import_module("pyrealsense2")
    clock = import_module("relmm.robot.hardware.clock")
    replace(clock, "now", shared.now)
    replace(clock, "sleep", shared.sleep)
    replace(fake, "now", shared.now)
    replace(fake, "still_s", _STILL_S)
    # LeRobot dates a picture when it has taken it over, which may be late.
    dates = SimpleNamespace(perf_counter=lambda: fake.taken, time=time.time, sleep=time.sleep)
    replace(camera, "time", dates)
    replace(import_module("dynamixel_sdk.port_handler"), "LATENCY_TIMER", _PATIENCE_MS)
    replace(import_module("relmm.robot.hardware.kobuki"), "_START_S", _START_S)
