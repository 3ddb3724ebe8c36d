"""The time of an emulated LoCoBot, shared by the process that emulates it and the one that drives it.

Either it runs by itself, at some speed against ours, or it passes only while the driving program sleeps: then neither a
busy machine nor a slow learner changes what happens, and an hour of the robot takes as long as its simulation.
"""

from __future__ import annotations

import mmap
import struct
import time
from pathlib import Path

_POLL_S = 0.0003


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
