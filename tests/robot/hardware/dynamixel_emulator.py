"""The Dynamixel chain of a LoCoBot speaking protocol 2.0, written from the e-manual and not from relmm's driver.

Positions are those that a motor tells: 4096 to a turn, 2048 in the middle. Which way a joint turns for them depends on
how the motor is mounted and on its drive mode, as on the robot.
"""

from __future__ import annotations

import math
import struct
import termios
import threading
import time
from collections.abc import Callable
from pathlib import Path

from pty_link import Cable

from relmm.robot.body import MAX_OPENING

BROADCAST = 0xFE
PING, READ, WRITE, REBOOT, STATUS, SYNC_READ, SYNC_WRITE = 0x01, 0x02, 0x03, 0x08, 0x55, 0x82, 0x83
INSTRUCTION_ERROR, CRC_ERROR, DATA_RANGE, DATA_LENGTH, DATA_LIMIT, ACCESS = 2, 3, 4, 5, 6, 7
ALERT = 0x80
BAUD = {0: 9600, 1: 57600, 2: 115200, 3: 1_000_000, 4: 2_000_000}
# Address and size of what the emulator knows the meaning of; the rest of the table is memory.
MODEL, FIRMWARE, ID, BAUD_RATE, DRIVE_MODE, OPERATING_MODE = (0, 2), (6, 1), (7, 1), (8, 1), (10, 1), (11, 1)
SECONDARY_ID, HOMING, MAX_POSITION, MIN_POSITION = (12, 1), (20, 4), (48, 4), (52, 4)
TORQUE, ERROR_STATUS, GOAL_PWM, PROFILE_ACC, PROFILE_VEL = (64, 1), (70, 1), (100, 2), (108, 4), (112, 4)
GOAL, MOVING, PRESENT_PWM, LOAD, PRESENT, TRAJECTORY = (116, 4), (122, 1), (124, 2), (126, 2), (132, 4), (140, 4)
VOLTAGE, TEMPERATURE = (144, 2), (146, 1)
READ_ONLY = [(0, 7), (70, 71), (120, 147)]
PWM_MODE = 16


CRANK, ROD, CLOSED = 0.014, 0.024, 0.030  # m, of the gripper; the last is between its carriages when the pads touch


def angle_of(opening: float) -> float:
    """The gripper motor's angle for an opening (m) between its pads, rad, at most where the crank stands upright."""
    finger = (min(max(opening, -0.005), MAX_OPENING) + CLOSED) / 2
    sine = (finger**2 + CRANK**2 - ROD**2) / (2 * CRANK * finger)
    return min(math.asin(min(max(sine, -1.0), 1.0)), math.radians(80))


def crc16(data: bytes) -> int:
    """CRC-16 of the e-manual: polynomial 0x8005, from the highest bit down."""
    crc = 0
    for byte in data:
        crc ^= byte << 8
        for _ in range(8):
            crc = ((crc << 1) ^ 0x8005 if crc & 0x8000 else crc << 1) & 0xFFFF
    return crc


def packet(identifier: int, instruction: int, parameters: bytes) -> bytes:
    stuffed = parameters.replace(b"\xff\xff\xfd", b"\xff\xff\xfd\xfd")
    head = b"\xff\xff\xfd\x00" + struct.pack("<BHB", identifier, len(stuffed) + 3, instruction)
    return head + stuffed + struct.pack("<H", crc16(head + stuffed))


class Motor:
    """One motor: its control table, and a shaft that follows its goal.

    Args:
        identifier: on the bus.
        model: its number.
        mounted: -1 where a positive joint angle needs a smaller position without reverse mode.
        angle: rad, of the joint at first.
    """

    def __init__(self, identifier: int, model: int, mounted: int = 1, angle: float = 0.0) -> None:
        self.table = bytearray(147)
        self.mounted = mounted
        self.angle = angle  # of the joint, rad
        self.speed = 0.0  # rad/s
        self.profile = (0.0, 0.0, 0.0, 0.0, 0.0)  # start and end in ticks, when, duration and acceleration time in s
        self.blocked: Callable[[float], float] = lambda angle: angle  # what stops the joint
        for register, value in (
            *((MODEL, model), (FIRMWARE, 45), (ID, identifier), (BAUD_RATE, 3), (OPERATING_MODE, 3)),
            *((SECONDARY_ID, 255), (MAX_POSITION, 4095), (MIN_POSITION, 0), (GOAL_PWM, 0)),
            *((VOLTAGE, 121), (TEMPERATURE, 33)),
        ):
            self.set(register, value)

    def get(self, register: tuple[int, int], signed: bool = False) -> int:
        return int.from_bytes(self.table[register[0] : sum(register)], "little", signed=signed)

    def set(self, register: tuple[int, int], value: int) -> None:
        self.table[register[0] : sum(register)] = (value % 256 ** register[1]).to_bytes(register[1], "little")

    @property
    def sign(self) -> int:
        return self.mounted * (-1 if self.get(DRIVE_MODE) & 1 else 1)

    @property
    def torque(self) -> bool:
        return bool(self.get(TORQUE))

    def ticks(self, angle: float) -> int:
        return round(2048 + self.sign * angle * 4096 / math.tau) + self.get(HOMING, signed=True)

    def to_angle(self, ticks: float) -> float:
        return self.sign * (ticks - self.get(HOMING, signed=True) - 2048) * math.tau / 4096

    # --- What a host does --------------------------------------------------------------------------------
    def write(self, address: int, data: bytes, now: float) -> int:
        end = address + len(data)
        if end > len(self.table) or any(low < end and address < high for low, high in READ_ONLY):
            return DATA_RANGE
        if address < 64 and self.torque:
            return ACCESS
        before = bytes(self.table)
        self.table[address:end] = data
        if address <= GOAL[0] < end and self.get(OPERATING_MODE) != PWM_MODE:
            goal = self.get(GOAL, signed=True)
            if not self.get(MIN_POSITION) <= goal <= self.get(MAX_POSITION):
                self.table[:] = before
                return DATA_LIMIT
            self._begin_profile(goal, now)
        if address <= TORQUE[0] < end and self.torque:
            if self.get(ERROR_STATUS):
                self.set(TORQUE, 0)
                return ACCESS
            self._begin_profile(self.ticks(self.angle), now)
            self.set(GOAL, self.ticks(self.angle))
        return 0

    def _begin_profile(self, goal: int, now: float) -> None:
        start = self.trajectory(now) if self.torque and self.profile[2] else float(self.ticks(self.angle))
        velocity, acceleration = self.get(PROFILE_VEL), self.get(PROFILE_ACC)
        if self.get(DRIVE_MODE) & 4:
            seconds, ramp = velocity / 1000, min(acceleration / 1000, velocity / 2000)
        else:
            rate = (velocity or 131) * 0.229 / 60 * 4096
            seconds, ramp = abs(goal - start) / rate, 0.0
        self.profile = (start, float(goal), now, seconds, ramp)

    def trajectory(self, now: float) -> float:
        start, goal, began, seconds, ramp = self.profile
        passed = max(now - began, 0.0)  # another thread may have begun it a moment later
        if passed >= seconds:
            return goal
        top = (goal - start) / (seconds - ramp)  # speed between the ramps
        if passed < ramp:
            return start + top * passed**2 / (2 * ramp)
        if passed > seconds - ramp:
            return goal - top * (seconds - passed) ** 2 / (2 * ramp)
        return start + top * (passed - ramp / 2)

    # --- What time does ----------------------------------------------------------------------------------
    def step(self, now: float, seconds: float) -> None:
        """Follow the goal, if nothing else moves the joint."""
        before = self.angle
        if self.torque and self.get(OPERATING_MODE) == PWM_MODE:
            pwm = self.get(GOAL_PWM, signed=True)
            self.angle = self.blocked(self.angle + self.sign * pwm / 885 * 6.0 * seconds)
        elif self.torque:
            goal = self.to_angle(self.trajectory(now))
            self.angle = self.blocked(self.angle + (goal - self.angle) * (1 - math.exp(-seconds / 0.02)))
        self.speed = (self.angle - before) / seconds if seconds else 0.0

    def refresh(self, now: float) -> None:
        self.set(PRESENT, self.ticks(self.angle))
        self.set(TRAJECTORY, round(self.trajectory(now)) if self.torque else self.ticks(self.angle))
        self.set(MOVING, abs(self.speed) > 0.02)
        self.set(PRESENT_PWM, self.get(GOAL_PWM, signed=True) if self.torque else 0)

    def fail(self, error: int) -> None:
        """A hardware error: the motor lets go, and says so with every answer, until it is rebooted."""
        self.set(ERROR_STATUS, error)
        self.set(TORQUE, 0)


def locobot_motors() -> dict[int, Motor]:
    """As a LoCoBot's chain comes from the factory, its arm lying folded in the rest pose."""
    xm430, xl430, double = 1020, 1060, 1090
    sleep = {1: 0.0, 2: -1.3, 3: -1.3, 4: 1.55, 5: 0.7, 6: 0.0, 7: 0.0, 10: 0.0, 11: 0.0}
    models = {1: xm430, 2: xm430, 3: xm430, 4: xm430, 5: xm430, 6: xl430, 7: xl430, 10: double, 11: double}
    return {i: Motor(i, model, -1 if i in (3, 4, 5, 11) else 1, sleep[i]) for i, model in models.items()}


class DynamixelEmulator:
    """Answers on a pseudo-terminal, from a thread of its own.

    Args:
        path: where the link to its device goes.
        motors: by id.
        now: its time, s.
        moves: whether the motors move by themselves; False if something else moves the joints.
    """

    def __init__(
        self,
        path: Path,
        motors: dict[int, Motor] | None = None,
        now: Callable[[], float] = time.monotonic,
        moves: bool = True,
    ) -> None:
        self.cable = Cable(path)
        self.motors = motors or locobot_motors()
        self.powered = True
        self.bad_packets = 0
        self.log: list[tuple[int, int, bytes]] = []  # (id, address, data) of what was written
        self.lock = threading.Lock()
        self._pending = bytearray()
        self.now, self._moves = now, moves
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._last = self.now()
        self._thread.start()

    def _run(self) -> None:
        while not self._stop.is_set():
            data = self.cable.read()
            with self.lock:
                self._let_time_pass()
                if data:
                    self._pending += data
                    self._obey()
            if not data:
                self.cable.wait(0.002)

    def _let_time_pass(self) -> None:
        now = self.now()
        if self._moves and now - self._last >= 0.002:
            for motor in self.motors.values():
                motor.step(now, now - self._last)
            shoulder, shadow = self.motors.get(2), self.motors.get(3)
            if shoulder and shadow:
                shadow.angle = shoulder.angle  # one axle
            self._last = now

    def _obey(self) -> None:
        data = self._pending
        while (start := data.find(b"\xff\xff\xfd\x00")) >= 0 and len(data) >= start + 7:
            length = int.from_bytes(data[start + 5 : start + 7], "little")
            end = start + 7 + length
            if len(data) < end:
                return
            whole = bytes(data[start:end])
            del data[:end]
            if crc16(whole[:-2]) != int.from_bytes(whole[-2:], "little"):
                self.bad_packets += 1
                continue
            self._execute(whole[4], whole[7], whole[8:-2].replace(b"\xff\xff\xfd\xfd", b"\xff\xff\xfd"))

    def _hears(self, motor: Motor) -> bool:
        return BAUD[motor.get(BAUD_RATE)] == _SPEEDS.get(termios.tcgetattr(self.cable._slave)[5])

    def _execute(self, identifier: int, instruction: int, parameters: bytes) -> None:
        heard = {i: motor for i, motor in self.motors.items() if self.powered and self._hears(motor)}
        if instruction == SYNC_READ:
            address, length = struct.unpack_from("<HH", parameters)
            for asked in parameters[4:]:
                if asked in heard:
                    self._answer(heard[asked], 0, self._read(heard[asked], address, length))
        elif instruction == SYNC_WRITE:
            address, length = struct.unpack_from("<HH", parameters)
            for start in range(4, len(parameters), length + 1):
                self._write(heard, parameters[start], address, parameters[start + 1 : start + 1 + length])
        elif identifier == BROADCAST and instruction == PING:
            for motor in heard.values():
                self._answer(motor, 0, motor.table[0:2] + motor.table[6:7])
        elif identifier in heard:
            self._execute_single(heard, identifier, instruction, parameters)

    def _execute_single(self, heard: dict[int, Motor], identifier: int, instruction: int, parameters: bytes) -> None:
        motor = heard[identifier]
        if instruction == PING:
            self._answer(motor, 0, motor.table[0:2] + motor.table[6:7])
        elif instruction == READ:
            self._answer(motor, 0, self._read(motor, *struct.unpack("<HH", parameters)))
        elif instruction == WRITE:
            self._answer(motor, self._write(heard, identifier, *_split(parameters)), b"")
        elif instruction == REBOOT:
            motor.set(ERROR_STATUS, 0)
            motor.set(TORQUE, 0)
            self._answer(motor, 0, b"")
        else:
            self._answer(motor, INSTRUCTION_ERROR, b"")

    def _read(self, motor: Motor, address: int, length: int) -> bytes:
        motor.refresh(self.now())
        return bytes(motor.table[address : address + length])

    def _write(self, heard: dict[int, Motor], identifier: int, address: int, data: bytes) -> int:
        """A motor obeys its own id and its secondary one; only the first answers."""
        self.log.append((identifier, address, data))
        for shadow in heard.values():
            if shadow.get(SECONDARY_ID) == identifier:
                shadow.write(address, data, self.now())
        return heard[identifier].write(address, data, self.now()) if identifier in heard else 0

    def _answer(self, motor: Motor, error: int, parameters: bytes) -> None:
        alert = ALERT if motor.get(ERROR_STATUS) else 0
        self.cable.write(packet(motor.get(ID), STATUS, bytes([error | alert]) + parameters))

    def close(self) -> None:
        self._stop.set()
        self._thread.join()
        self.cable.close()

    def __enter__(self) -> DynamixelEmulator:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _split(parameters: bytes) -> tuple[int, bytes]:
    return int.from_bytes(parameters[:2], "little"), parameters[2:]


_SPEEDS = {getattr(termios, f"B{rate}"): rate for rate in (9600, 57600, 115200, 1_000_000, 2_000_000)}
