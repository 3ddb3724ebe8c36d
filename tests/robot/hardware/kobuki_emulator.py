"""A Kobuki at the level of bytes, written from its protocol specification and not from relmm's driver.

from kobuki_emulator import KobukiEmulator
with KobukiEmulator(tmp_path / "kobuki") as base: ...
"""

from __future__ import annotations

import math
import random
import struct
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Protocol

from pty_link import Cable

PERIOD_S = 0.02
TICKS_PER_METRE = 11_724.41
TRACK = 0.230


def encode_frame(payload: bytes) -> bytes:
    body = bytes([len(payload)]) + payload
    check = 0
    for byte in body:
        check ^= byte
    return b"\xaa\x55" + body + bytes([check])


class Plant(Protocol):
    """What the base's wheels move."""

    def step(self, seconds: float, x_vel: float, theta_vel: float) -> None:
        """Drive at m/s and rad/s for a while."""

    def sensors(self) -> tuple[float, float, float, int]:
        """m that the left and the right wheel have rolled, heading in degrees, and the bumper's bits."""


class RollingBase:
    """A base on an empty floor: its wheels reach a commanded speed within a tenth of a second."""

    def __init__(self) -> None:
        self.left = self.right = self.heading = 0.0
        self.x = self.y = 0.0
        self.speed = self.turn = 0.0

    def step(self, seconds: float, x_vel: float, theta_vel: float) -> None:
        blend = 1 - math.exp(-seconds / 0.03)
        self.speed += (x_vel - self.speed) * blend
        self.turn += (theta_vel - self.turn) * blend
        if (x_vel, theta_vel) == (0, 0) and abs(self.speed) < 1e-3 and abs(self.turn) < 1e-2:
            self.speed = self.turn = 0.0
        self.left += (self.speed - self.turn * TRACK / 2) * seconds
        self.right += (self.speed + self.turn * TRACK / 2) * seconds
        self.x += self.speed * math.cos(math.radians(self.heading)) * seconds
        self.y += self.speed * math.sin(math.radians(self.heading)) * seconds
        self.heading += math.degrees(self.turn) * seconds

    def sensors(self) -> tuple[float, float, float, int]:
        return self.left, self.right, self.heading, 0


class KobukiEmulator:
    """Answers as a base does, on a pseudo-terminal, from a thread of its own.

    It drives at its last command for ever, as nothing in its documents says otherwise.

    Args:
        path: where the link to its device goes.
        plant: what it moves.
        threaded: False if `tick` is called from elsewhere.
    """

    def __init__(self, path: Path, plant: Plant | None = None, threaded: bool = True) -> None:
        self.plant: Plant = plant or RollingBase()
        self.cable = Cable(path)
        self.battery = 16.0  # V
        self.charger = self.cliff = self.wheel_drop = self.over_current = self.buttons = 0
        self.bumper = 0  # on top of what the plant says
        self.first_tick = (0, 0)  # of the encoders
        self.powered = True
        self.noise: Callable[[bytes], bytes] = lambda data: data
        self.command = (0, 0)  # mm/s and mm
        self.commands: list[tuple[float, int, int]] = []  # (time, mm/s, mm)
        self.sounds: list[int] = []
        self.output = 0
        self.bad_bytes = 0
        self._pending = bytearray()
        self._timestamp = 0
        self._asked = False
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True) if threaded else None
        if self._thread is not None:
            self._thread.start()

    # --- What happens every 20 ms ------------------------------------------------------------------------
    def tick(self) -> None:
        self.receive()
        self.plant.step(PERIOD_S, *(self.velocity() if self.powered else (0.0, 0.0)))
        self._timestamp = (self._timestamp + 20) % 65536
        if self.powered:
            self.cable.write(self.noise(encode_frame(self._feedback())))

    def velocity(self) -> tuple[float, float]:
        """m/s and rad/s of the command, by the specification."""
        speed, radius = self.command
        if radius == 0:
            return speed / 1000, 0.0
        if radius in (1, -1):
            return 0.0, speed / 1000 / (TRACK / 2)
        turn = speed / (radius + (TRACK * 500 if radius > 0 else -TRACK * 500))
        return radius / 1000 * turn, turn

    def receive(self) -> None:
        self._pending += self.cable.read()
        while len(self._pending) >= 4:
            if self._pending[:2] != b"\xaa\x55":
                del self._pending[0]
                self.bad_bytes += 1
                continue
            size = self._pending[2]
            if len(self._pending) < size + 4:
                return
            whole = bytes(self._pending[: size + 4])
            if encode_frame(whole[3:-1]) != whole:
                del self._pending[0]
                self.bad_bytes += 1
                continue
            del self._pending[: size + 4]
            self._obey(whole[3:-1])

    def _obey(self, payload: bytes) -> None:
        while payload:
            identifier, size = payload[:2]
            data, payload = payload[2 : 2 + size], payload[2 + size :]
            if identifier == 1 and size == 4:
                self.command = struct.unpack("<hh", data)
                self.commands.append((time.monotonic(), *self.command))
            elif identifier == 4 and size == 1:
                self.sounds.append(data[0])
            elif identifier == 9 and size == 2:
                self._asked = True
            elif identifier == 12 and size == 2:
                self.output = struct.unpack("<H", data)[0]
            else:
                raise AssertionError(f"no such command: {identifier} {data.hex()}")

    def _feedback(self) -> bytes:
        left, right, heading, bumper = self.plant.sensors()
        ticks = [
            (first + round(m * TICKS_PER_METRE)) % 65536
            for first, m in zip(self.first_tick, (left, right), strict=False)
        ]
        angle = (round(heading * 100) + 18000) % 36000 - 18000
        basic = struct.pack(
            "<HBBBHHbbBBBB",
            *(self._timestamp, bumper | self.bumper, self.wheel_drop, self.cliff, *ticks, 0, 0),
            *(self.buttons, self.charger, round(self.battery * 10), self.over_current),
        )
        parts = [(1, basic), (3, bytes(3)), (4, struct.pack("<hh3x", angle, 0)), (5, struct.pack("<HHH", *[1500] * 3))]
        # AA 55 inside a payload, as a gyro may well tell
        parts += [(6, bytes(2)), (13, bytes([self._timestamp // 20 % 256, 6]) + b"\xaa\x55\x06\x01\x04\x00" * 2)]
        parts += [(16, bytes(16))]
        if self._asked:
            parts += [(10, bytes([4, 0, 1, 0])), (11, bytes([0, 2, 1, 0])), (19, bytes(range(12)))]
            self._asked = False
        return b"".join(bytes([identifier, len(data)]) + data for identifier, data in parts)

    def _run(self) -> None:
        due = time.monotonic()
        while not self._stop.is_set():
            self.tick()
            due += PERIOD_S
            time.sleep(max(due - time.monotonic(), 0))

    # --- Faults ------------------------------------------------------------------------------------------
    def unplug(self) -> None:
        self.cable.unplug()
        self._pending.clear()

    def plug(self) -> None:
        self.cable.plug()

    def close(self) -> None:
        self._stop.set()
        if self._thread is not None:
            self._thread.join()
        self.cable.close()

    def __enter__(self) -> KobukiEmulator:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def noisy(rng: random.Random) -> Callable[[bytes], bytes]:
    """Some frames lose bytes, get some changed, or come with rubbish around them."""

    def change(data: bytes) -> bytes:
        kind, place = rng.randrange(8), rng.randrange(len(data))
        if kind == 0:
            return data[:place] + bytes([data[place] ^ rng.randrange(1, 256)]) + data[place + 1 :]
        if kind == 1:
            return data[:place]
        if kind == 2:
            return rng.randbytes(rng.randrange(40)) + data + b"\xaa\x55"
        return data

    return change
