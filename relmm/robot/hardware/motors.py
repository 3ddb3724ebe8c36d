"""The LoCoBot's Dynamixel chain: which motor is where, how it is set, and LeRobot's bus that speaks to it.

Source: `locobot_wx200.yaml` of Interbotix (BSD-3), and the e-manual of the X series.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

from lerobot.motors import Motor, MotorNormMode
from lerobot.motors.dynamixel import DynamixelMotorsBus
from lerobot.motors.dynamixel.tables import (
    MODEL_BAUDRATE_TABLE,
    MODEL_CONTROL_TABLE,
    MODEL_ENCODING_TABLE,
    MODEL_NUMBER_TABLE,
    MODEL_RESOLUTION,
)

BAUD_RATE, FACTORY_BAUD_RATE = 1_000_000, 57_600
RADIANS_PER_TICK = math.tau / 4096
MIDDLE = 2048  # ticks at 0 rad
POSITION_MODE, PWM_MODE = 3, 16
_REVERSE, _TIME_BASED = 1, 4  # bits of the drive mode
_NO_SECONDARY = 255
_READ_S = 0.002
_VELOCITY_LIMIT = 131  # of 0.229 turns a minute: pi rad/s


@dataclass(frozen=True)
class Joint:
    """One motor as it has to be set.

    Attributes:
        id: on the bus.
        model: by LeRobot's name.
        reverse: it is mounted the other way round.
        limits: of its position, ticks.
        follows: id of the motor on the same axle that it obeys too.
        by_time: its moves are given by their duration, not by their speed.
        mode: of operation.
    """

    id: int
    model: str
    reverse: bool = False
    limits: tuple[int, int] = (0, 4095)
    follows: int = _NO_SECONDARY
    by_time: bool = True
    mode: int = POSITION_MODE

    def settings(self) -> dict[str, int]:
        """Registers that outlast a power cut, and can be written only while the motor is limp."""
        return {
            "Return_Delay_Time": 0,
            "Drive_Mode": _REVERSE * self.reverse + _TIME_BASED * self.by_time,
            "Operating_Mode": self.mode,
            "Secondary_ID": self.follows,
            "Velocity_Limit": _VELOCITY_LIMIT,
            "Max_Position_Limit": self.limits[1],
            "Min_Position_Limit": self.limits[0],
        }


_XM430, _XL430, _DOUBLE_XL430 = "xm430-w350", "xl430-w250", "2xl430-w250"
ARM = ("waist", "shoulder", "elbow", "wrist_angle", "wrist_rotate")
SHADOW, GRIPPER, PAN, TILT = "shoulder_shadow", "gripper", "pan", "tilt"
JOINTS = {
    "waist": Joint(1, _XM430),
    "shoulder": Joint(2, _XM430, limits=(819, 3333)),
    SHADOW: Joint(3, _XM430, reverse=True, limits=(819, 3333), follows=2),
    "elbow": Joint(4, _XM430, reverse=True, limits=(819, 3106)),
    "wrist_angle": Joint(5, _XM430, reverse=True, limits=(910, 3447)),
    "wrist_rotate": Joint(6, _XL430),
    GRIPPER: Joint(7, _XL430, by_time=False, mode=PWM_MODE),
    PAN: Joint(10, _DOUBLE_XL430, limits=(1024, 3072)),
    TILT: Joint(11, _DOUBLE_XL430, reverse=True, limits=(1024, 3072)),
}


def to_ticks(radians: float) -> int:
    """Position of a motor for an angle of its joint.

    LeRobot's own degrees are not used: their zero is the middle of a joint's range, 2.5 degrees off at the shoulder.
    """
    return round(MIDDLE + radians / RADIANS_PER_TICK)


def to_radians(ticks: float) -> float:
    """Angle of a joint for a position of its motor."""
    return (ticks - MIDDLE) * RADIANS_PER_TICK


def _with_double[Entry](table: dict[str, Entry]) -> dict[str, Entry]:
    return {**table, _DOUBLE_XL430: table[_XL430]}


class LocobotMotorsBus(DynamixelMotorsBus):
    """LeRobot's bus, which also knows the double motor under the camera.

    Args:
        port: of the chain's adapter.
        names: which of `JOINTS` are expected on it.
    """

    default_timeout = 100  # ms; at 1 Mbaud an answer takes less than one
    # The motors of a 2XL430 are XL430 under another number.
    model_encoding_table: ClassVar[dict[str, dict[str, int]]] = _with_double(MODEL_ENCODING_TABLE)
    model_resolution_table: ClassVar[dict[str, int]] = _with_double(MODEL_RESOLUTION)
    model_number_table: ClassVar[dict[str, int]] = {**MODEL_NUMBER_TABLE, _DOUBLE_XL430: 1090}
    model_ctrl_table: ClassVar[dict[str, dict[str, tuple[int, int]]]] = _with_double(MODEL_CONTROL_TABLE)
    model_baudrate_table: ClassVar[dict[str, dict[int, int]]] = _with_double(MODEL_BAUDRATE_TABLE)

    def __init__(self, port: str, names: tuple[str, ...] = tuple(JOINTS)) -> None:
        motors = {name: Motor(JOINTS[name].id, JOINTS[name].model, MotorNormMode.DEGREES) for name in names}
        super().__init__(port, motors)
        # The SDK of LeRobot's range flushes what it sends here, and not what it has received: an answer that came too
        # late would be taken for that of the next question, and so on for ever.
        self.port_handler.clearPort = lambda: self.port_handler.ser.reset_input_buffer()
        self.port_handler.readPort = self._read_port

    def _read_port(self, length: int) -> bytes:
        """Wait a moment for that many bytes. The SDK asks again and again, and would keep a processor busy with it."""
        port = self.port_handler.ser
        if port.timeout != _READ_S:
            port.timeout = _READ_S
        return bytes(port.read(length))

    def ping(self, motor: str | int, num_retry: int = 2, raise_on_error: bool = False) -> int | None:
        """Model of a motor, None if it is silent.

        LeRobot's counts a motor as missing when one answer was lost, or when the motor reports an error of its own.
        """
        for _ in range(1 + num_retry):
            model, result, _ = self.packet_handler.ping(self.port_handler, self._get_motor_id(motor))
            if self._is_comm_success(result):
                return int(model)
        if raise_on_error:
            raise ConnectionError(f"Motor {motor} is silent.")
        return None
