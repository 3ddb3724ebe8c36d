"""The bytes that a Kobuki base and its host exchange, as pure functions.

A frame is `AA 55`, the payload's length, the payload, and the XOR of the length and the payload. A payload is a row of
sub-payloads: an id, a size, and that many bytes. Numbers are little-endian.

Source: the protocol specification and the driver of yujinrobot/kobuki_core (BSD).
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from enum import IntEnum, IntFlag
from functools import reduce
from operator import xor

BAUD_RATE = 115_200
PERIOD_S = 0.02  # the base sends by itself at 50 Hz, and its commands are repeated as often
WHEELBASE = 0.230  # m
TICKS_PER_TURN = 52 * 6545 / 132  # of a wheel: 52 of the motor, times the gear
M_PER_TICK = 2 * math.pi * 0.035 / TICKS_PER_TURN

# V. Below LOW the manufacturer's driver warns, below EMPTY it calls the battery dangerously empty; CHARGED is ours.
BATTERY_FULL, BATTERY_CHARGED, BATTERY_LOW, BATTERY_EMPTY = 16.5, 16.0, 14.0, 13.2

_HEADER = b"\xaa\x55"
_MIN_PAYLOAD, _MAX_PAYLOAD = 3, 160  # bytes; the base's largest is 124, and a false length must not hide what follows
_STRAIGHT, _ON_THE_SPOT, _SMALLEST_RADIUS = 1e-4, 1e-4, 1e-3  # rad/s, m/s and m below which the driver rounds
_INT16 = 32_767


class Command(IntEnum):
    """Ids of what the host sends."""

    BASE_CONTROL = 0x01
    SOUND_SEQUENCE = 0x04
    REQUEST_EXTRA = 0x09
    GENERAL_OUTPUT = 0x0C


class Sound(IntEnum):
    """The base's own tunes."""

    ON = 0
    OFF = 1
    RECHARGE = 2
    BUTTON = 3
    ERROR = 4
    CLEANING_START = 5
    CLEANING_END = 6


class Output(IntFlag):
    """Power for what is plugged into the base, and its two lights."""

    POWER = 0x10 | 0x20 | 0x40 | 0x80  # 3.3 V, 5 V, and both 12 V: the arm hangs on one of them
    LED1_RED = 0x100
    LED1_GREEN = 0x200
    LED2_RED = 0x400
    LED2_GREEN = 0x800


class WheelDrop(IntFlag):
    """Wheels that hang in the air."""

    RIGHT = 1
    LEFT = 2


class Charger(IntEnum):
    """What charges the battery."""

    NONE = 0
    DOCK_FULL = 2
    DOCK_CHARGING = 6
    ADAPTER_FULL = 18
    ADAPTER_CHARGING = 22


# --- From the host to the base -------------------------------------------------------------------------------
def frame(*sub_payloads: bytes) -> bytes:
    """One frame of one or more commands."""
    payload = b"".join(sub_payloads)
    body = bytes([len(payload)]) + payload
    return _HEADER + body + bytes([_checksum(body)])


def base_control(x_vel: float, theta_vel: float) -> bytes:
    """Drive in an arc.

    Args:
        x_vel: m/s.
        theta_vel: rad/s, positive = left.
    """
    half = WHEELBASE / 2
    if abs(theta_vel) < _STRAIGHT:
        speed, radius = x_vel, 0.0
    elif abs(x_vel) < _ON_THE_SPOT or abs(x_vel / theta_vel) <= _SMALLEST_RADIUS:
        speed, radius = theta_vel * half, 0.001
    else:
        radius = x_vel / theta_vel
        speed = (radius + half if radius > 0 else radius - half) * theta_vel
    return _sub_payload(Command.BASE_CONTROL, struct.pack("<hh", _millimetres(speed), _millimetres(radius)))


def sound(sequence: Sound) -> bytes:
    """Play a tune."""
    return _sub_payload(Command.SOUND_SEQUENCE, bytes([sequence]))


def general_output(output: int) -> bytes:
    """Switch lights and power; `output` is a sum of `Output`, what is missing goes off."""
    return _sub_payload(Command.GENERAL_OUTPUT, struct.pack("<H", output))


def request_versions() -> bytes:
    """Ask for hardware version, firmware version and unique id."""
    return _sub_payload(Command.REQUEST_EXTRA, struct.pack("<H", 0x01 | 0x02 | 0x08))


def velocity(control: bytes) -> tuple[float, float]:
    """What a base makes of the data of `base_control`: m/s and rad/s."""
    speed, radius = (value / 1000.0 for value in struct.unpack("<hh", control))
    if radius == 0:
        return speed, 0.0
    if abs(radius) <= _SMALLEST_RADIUS:
        return 0.0, speed * 2 / WHEELBASE
    theta_vel = speed / (radius + WHEELBASE / 2 if radius > 0 else radius - WHEELBASE / 2)
    return radius * theta_vel, theta_vel


# --- From the base to the host -------------------------------------------------------------------------------
@dataclass(frozen=True)
class Feedback:
    """What one frame of the base says; what it leaves out is None.

    Attributes:
        timestamp: ms, wraps at 65,536.
        bumper: sum of 1 right, 2 centre, 4 left; `cliff` likewise.
        wheel_drop: sum of `WheelDrop`.
        left, right: encoder ticks, wrap at 65,536.
        buttons: sum of 1, 2, 4.
        charger: a `Charger`.
        battery: V.
        over_current: sum of 1 left, 2 right.
        angle: degrees by the gyro, wraps at 360.
        rate: deg/s by the gyro.
        firmware: its version.
    """

    timestamp: int
    bumper: int
    wheel_drop: int
    cliff: int
    left: int
    right: int
    buttons: int
    charger: int
    battery: float
    over_current: int
    angle: float | None = None
    rate: float | None = None
    firmware: tuple[int, int, int] | None = None


_BASIC, _INERTIA, _FIRMWARE = 0x01, 0x04, 0x0B
_BASIC_DATA = struct.Struct("<HBBBHHbbBBBB")
# Sizes of all the base may send, in bytes; the raw gyro's varies.
_SIZES = {_BASIC: 15, 0x03: 3, _INERTIA: 7, 0x05: 6, 0x06: 2, 0x0A: 4, _FIRMWARE: 4, 0x10: 16, 0x13: 12, 0x15: 13}


def decode(payload: bytes) -> Feedback | None:
    """What a payload says; None where it says nothing about the base, or cannot be from one.

    Sub-payloads that are not known are skipped.
    """
    parts = dict(sub_payloads(payload))
    if any(identifier in _SIZES and len(data) != _SIZES[identifier] for identifier, data in parts.items()):
        return None
    if _BASIC not in parts:
        return None
    time, bumper, drop, cliff, left, right, _, _, buttons, charger, battery, over = _BASIC_DATA.unpack(parts[_BASIC])
    if bumper > 7 or drop > 3 or cliff > 7 or buttons > 7 or over > 3 or charger not in Charger:
        return None
    angle, rate = struct.unpack_from("<hh", parts[_INERTIA]) if _INERTIA in parts else (None, None)
    version = parts.get(_FIRMWARE)
    return Feedback(
        *(time, bumper, drop, cliff, left, right, buttons, charger, battery / 10, over),
        angle=None if angle is None else angle / 100,
        rate=None if rate is None else rate / 100,
        firmware=None if version is None else (version[2], version[1], version[0]),
    )


def sub_payloads(payload: bytes) -> Iterator[tuple[int, bytes]]:
    """Ids and data of a payload that `FrameReader` has let through."""
    start = 0
    while start < len(payload):
        identifier, size = payload[start : start + 2]
        yield identifier, payload[start + 2 : start + 2 + size]
        start += 2 + size


class FrameReader:
    """Finds frames in a stream of bytes that come in pieces of any size, with noise between and inside them."""

    def __init__(self) -> None:
        self._buffer = bytearray()

    def feed(self, data: bytes) -> list[bytes]:
        """Take what has come in; the payloads that are complete with it."""
        self._buffer += data
        return list(self._payloads())

    def _payloads(self) -> Iterable[bytes]:
        buffer = self._buffer
        start = 0
        while (start := buffer.find(_HEADER, start)) >= 0 and start + 2 < len(buffer):
            length = buffer[start + 2]
            end = start + 3 + length
            if not _MIN_PAYLOAD <= length <= _MAX_PAYLOAD:
                start += 1  # a header may follow in what was taken for a frame
            elif end >= len(buffer):
                break
            elif _is_frame(buffer[start + 2 : end + 1]):
                yield bytes(buffer[start + 3 : end])
                start = end + 1
            else:
                start += 1
        # What cannot be the beginning of a frame any more is forgotten; a lone AA at the end may be.
        del buffer[: start if start >= 0 else len(buffer) - buffer.endswith(_HEADER[:1])]


def _is_frame(body: bytearray) -> bool:
    """Whether length, payload and check sum fit together. The sum alone lets every 256th piece of noise through."""
    return _checksum(body[:-1]) == body[-1] and _is_tiled(body[1:-1])


def _is_tiled(payload: bytearray) -> bool:
    """Whether sub-payloads fill a payload exactly."""
    start = 0
    while start + 2 <= len(payload):
        start += 2 + payload[start + 1]
    return start == len(payload)


def _sub_payload(identifier: int, data: bytes) -> bytes:
    return bytes([identifier, len(data)]) + data


def _checksum(body: bytes | bytearray) -> int:
    return reduce(xor, body, 0)


def _millimetres(metres: float) -> int:
    return int(min(max(metres * 1000, -_INT16), _INT16))


STOP = frame(base_control(0.0, 0.0))
