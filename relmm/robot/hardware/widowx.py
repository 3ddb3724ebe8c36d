"""The driver of the WidowX-200 arm, its gripper, and the pan-tilt head of the camera."""

from __future__ import annotations

import logging
import termios
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from relmm.errors import RobotError
from relmm.features import FloatArray
from relmm.geometry import arm_forward
from relmm.robot.body import MAX_OPENING
from relmm.robot.hardware import clock
from relmm.robot.hardware.arm_safety import check_way
from relmm.robot.hardware.gripper import GripperControl, opening_of
from relmm.robot.hardware.motors import (
    ARM,
    GRIPPER,
    JOINTS,
    PAN,
    SHADOW,
    TILT,
    LocobotMotorsBus,
    to_radians,
    to_ticks,
)

logger = logging.getLogger(__name__)

SLEEP_POSE = np.array([0.0, -1.3, 1.55, 0.7, 0.0])  # rad; the arm lies in it without torque
AT_REST = 0.25  # rad from the sleep pose, at most, where losing torque does no harm
MAX_TEMPERATURE = 70  # degrees Celsius; the motors switch themselves off at 72 (XL430) and 80 (XM430)
_SAME_AXLE = 20  # ticks between the two motors of the shoulder
_LAY_DOWN_S, _HEAD_S = 2.5, 1.0
_HEALTH_S = 0.5  # between looks at errors and temperatures
_GOALS = 10  # looks that are remembered, some 0.4 s
_RETRIES = 2  # of a read or write whose answer was lost
_ERRORS = {1: "input voltage", 4: "overheating", 8: "encoder", 16: "electrical shock", 32: "overload"}
NO_SDK = "The arm needs dynamixel-sdk: pip install 'lerobot_policy_relmm[hardware]'."


@dataclass(frozen=True)
class ArmState:
    """One reading of the arm.

    Attributes:
        joints: rad, shape (5,).
        goal: rad, where the motors' profiles say that the joints are at this moment, shape (5,).
        opening: m, between the finger pads.
    """

    joints: FloatArray
    goal: FloatArray
    opening: float


class WidowX:
    """An arm that moves only where it may, and is limp only where it lies.

    Args:
        port: of the adapter of its motors.
        sag: rad that each joint is lifted with the arm stretched out level, because it hangs; from the calibration,
            shape (5,).
        closed_opening: m that the gripper tells when its pads touch, from the calibration.
        delay: s that the joints trail behind the motors' profiles, from the calibration.
        dry: only listen; nothing moves.
    """

    def __init__(
        self, port: str, sag: FloatArray, closed_opening: float = 0.0, delay: float = 0.0, dry: bool = False
    ) -> None:
        self.port, self._sag, self._closed, self._dry = port, sag, closed_opening, dry
        self._delay = delay
        self._goals: deque[tuple[float, FloatArray]] = deque(maxlen=_GOALS)
        self._gripper = GripperControl()
        self._pwm = 0
        self._next_health = float("-inf")
        self._mirrored: set[str] = set()  # in a dry run: motors that are not set up yet, and tell the other direction
        self._bus = _open_bus(port)

    # --- Settings ----------------------------------------------------------------------------------------
    def configure(self) -> None:
        """Write the settings that differ from the right ones, and take hold of the arm where it is.

        Raises:
            RobotError: a motor is broken, or its settings are wrong and it holds the arm up, so that they cannot be
                changed.
        """
        self.check_health()
        ticks = self._read("Present_Position", ("shoulder", SHADOW))
        if abs(ticks["shoulder"] - ticks[SHADOW]) > _SAME_AXLE and self._configured(SHADOW):
            raise RobotError(
                f"The two motors of the shoulder (2 and 3) disagree by {abs(ticks['shoulder'] - ticks[SHADOW])} of "
                "4096 ticks, and would fight: set the Homing_Offset of motor 3 so that both tell the same position."
            )
        for name in JOINTS:
            self._set_up(name)
        if not self._dry:
            self._take_hold()

    def _configured(self, name: str) -> bool:
        return all(self._read_one(register, name) == value for register, value in JOINTS[name].settings().items())

    def _set_up(self, name: str) -> None:
        wrong = {
            register: value
            for register, value in JOINTS[name].settings().items()
            if self._read_one(register, name) != value
        }
        if self._dry:
            if "Drive_Mode" in wrong and (self._read_one("Drive_Mode", name) ^ wrong["Drive_Mode"]) & 1:
                self._mirrored.add(name)
            return
        if not wrong:
            return
        if self._read_one("Torque_Enable", name):
            if name in ARM and not self.lies():
                raise RobotError(
                    f"Motor {JOINTS[name].id} ({name}) has other settings than relmm needs ({', '.join(wrong)}), and "
                    "they can be changed only while it is limp: hold the arm, switch the robot off and on, lay the arm "
                    "down folded, and start again."
                )
            self._write("Torque_Enable", name, 0)
        for register, value in wrong.items():
            self._write(register, name, value)
        logger.info("Motor %d (%s) was set up: %s.", JOINTS[name].id, name, ", ".join(wrong))

    def _take_hold(self) -> None:
        """Torque on, without a jerk: every motor's goal is where it is."""
        held = [name for name in JOINTS if name != GRIPPER]
        for name in held:
            if not self._read_one("Torque_Enable", name):
                self._write("Profile_Velocity", name, 0)
                self._write("Goal_Position", name, self._read_one("Present_Position", name))
                self._write("Torque_Enable", name, 1)
        self._write("Goal_PWM", GRIPPER, 0)
        self._write("Torque_Enable", GRIPPER, 1)

    # --- Reading -----------------------------------------------------------------------------------------
    def state(self) -> ArmState:
        """Read the joints and the gripper.

        Raises:
            RobotError: the arm does not answer.
        """
        present = self._read("Present_Position", (*ARM, GRIPPER))
        goal = self._read("Position_Trajectory", ARM)
        joints, asked = self._angles(present), self._angles(goal)
        return ArmState(joints, self._trailing(asked - self._lift(asked)), self._opening(present[GRIPPER]))

    def _trailing(self, goal: FloatArray) -> FloatArray:
        """Where the profiles were as long ago as the joints trail behind them."""
        now = clock.now()
        self._goals.append((now, goal))
        times, goals = zip(*self._goals, strict=True)
        return np.array([np.interp(now - self._delay, times, joint) for joint in np.transpose(goals)])

    def _angles(self, ticks: dict[str, int]) -> FloatArray:
        return np.array([to_radians(ticks[name]) * (-1 if name in self._mirrored else 1) for name in ARM])

    def _opening(self, ticks: int) -> float:
        return opening_of(to_radians(ticks)) - self._closed

    def head(self) -> tuple[float, float]:
        """Pan and tilt of the camera, rad."""
        ticks = self._read("Present_Position", (PAN, TILT))
        return to_radians(ticks[PAN]), to_radians(ticks[TILT])

    def lies(self) -> bool:
        """Whether the arm lies in its sleep pose, where it may become limp."""
        ticks = self._read("Present_Position", ARM)
        joints = self._angles(ticks)
        return bool(np.abs(joints - SLEEP_POSE)[1:4].max() < AT_REST)

    def check_health(self) -> None:
        """Look at errors and temperatures, twice a second at most.

        Raises:
            RobotError: a motor has switched itself off, or is too hot; says what to do.
        """
        if clock.now() < self._next_health:
            return
        self._next_health = clock.now() + _HEALTH_S
        names = tuple(JOINTS)
        for name, error in self._read("Hardware_Error_Status", names).items():
            if error:
                raise RobotError(
                    f"Motor {JOINTS[name].id} ({name}) has switched itself off: {error_words(error)}. Hold the arm, "
                    "switch the robot off, free what is stuck, let it cool down, and start again."
                )
        for name, temperature in self._read("Present_Temperature", names).items():
            if temperature > MAX_TEMPERATURE:
                raise RobotError(
                    f"Motor {JOINTS[name].id} ({name}) is at {temperature} degrees C, and {MAX_TEMPERATURE} are "
                    "allowed: let it cool down."
                )

    # --- Moving ------------------------------------------------------------------------------------------
    def move(self, joints: FloatArray, seconds: float) -> None:
        """Move to a goal (rad, shape (5,)) on a profile of that duration, if the way there is free of the robot itself.

        Raises:
            RobotError: it is not, or the arm does not answer. Nothing has moved then.
        """
        check_way(self.state().joints, joints)
        self._send(joints, seconds)

    def hold(self) -> None:
        """Stay where the arm is."""
        self._send(self.state().joints, 0.0)

    def _send(self, joints: FloatArray, seconds: float) -> None:
        if self._dry:
            return
        duration = max(round(seconds * 1000), 20)
        # A third of the time for each ramp: the speed peaks at 1.5 times its mean, as of the skills' smooth profile.
        self._write_all("Profile_Velocity", dict.fromkeys(ARM, duration))
        self._write_all("Profile_Acceleration", dict.fromkeys(ARM, duration // 3))
        goal = joints + self._lift(joints)
        limits = np.array([JOINTS[name].limits for name in ARM])
        ticks = np.clip([to_ticks(angle) for angle in goal], limits[:, 0], limits[:, 1])
        self._write_all("Goal_Position", dict(zip(ARM, ticks.tolist(), strict=True)))

    def _lift(self, joints: FloatArray) -> FloatArray:
        """By how much the goal has to be higher than where the arm is to be, because it hangs; rad, shape (5,)."""
        return self._sag * load_of(joints)

    def look(self, pan: float, tilt: float) -> None:
        """Turn the camera (rad)."""
        if self._dry:
            return
        self._write_all("Profile_Velocity", dict.fromkeys((PAN, TILT), round(_HEAD_S * 1000)))
        self._write_all("Profile_Acceleration", dict.fromkeys((PAN, TILT), round(_HEAD_S * 300)))
        self._write_all("Goal_Position", {PAN: to_ticks(pan), TILT: to_ticks(tilt)})

    def set_gripper(self, opening: float) -> None:
        """Move the fingers towards an opening (m); below 0 squeezes. `update` has to be called while they move."""
        self._gripper.move(min(opening, MAX_OPENING), self.state().opening, clock.now())
        self.update()

    def update(self) -> None:
        """Apply the gripper's voltage for this moment."""
        ticks = self._read("Present_Position", (GRIPPER,))
        pwm = self._gripper.pwm(self._opening(ticks[GRIPPER]), clock.now())
        if pwm != self._pwm and not self._dry:
            self._write("Goal_PWM", GRIPPER, pwm)
            self._pwm = pwm

    def lie_down(self, wait: Callable[[float], None]) -> None:
        """Fold the arm onto the robot and make it limp; where it does not get there it stays held.

        Args:
            wait: lets time pass, s.
        """
        if self._dry:
            return
        self.move(SLEEP_POSE, _LAY_DOWN_S)
        wait(_LAY_DOWN_S + 0.3)
        if not self.lies():
            logger.warning("Something keeps the arm from lying down: it stays held. Support it before you switch off.")
            return
        for name in JOINTS:
            self._write("Torque_Enable", name, 0)

    def close(self) -> None:
        """Let go of the port; the motors keep what they do."""
        if self._bus.is_connected:
            self._bus.disconnect(disable_torque=False)

    # --- The bus -----------------------------------------------------------------------------------------
    def _read(self, register: str, names: tuple[str, ...]) -> dict[str, int]:
        return dict(self._ask(lambda: self._bus.sync_read(register, list(names), normalize=False, num_retry=_RETRIES)))

    def _read_one(self, register: str, name: str) -> int:
        return int(self._ask(lambda: self._bus.read(register, name, normalize=False, num_retry=_RETRIES)))

    def _write(self, register: str, name: str, value: int) -> None:
        self._ask(lambda: self._bus.write(register, name, value, normalize=False, num_retry=_RETRIES))

    def _write_all(self, register: str, values: dict[str, int]) -> None:
        self._ask(lambda: self._bus.sync_write(register, values, normalize=False))

    def _ask(self, question: Callable[[], Any]) -> Any:
        try:
            return question()
        # A motor that is silent, or a cable that is out; the SDK also stumbles over answers that were cut short.
        except (ConnectionError, OSError, termios.error, IndexError) as error:
            raise RobotError(
                f"The arm does not answer on {self.port} ({_first_line(error)}): check its power and cable."
            ) from error
        except RuntimeError as error:  # a motor's own refusal
            raise RobotError(f"A motor of the arm refuses: {_first_line(error)} Run relmm-doctor.") from error


def _open_bus(port: str) -> LocobotMotorsBus:
    try:
        bus = LocobotMotorsBus(port)
        bus.connect()
    except ImportError as error:
        raise RobotError(NO_SDK) from error
    except (ConnectionError, OSError, RuntimeError, termios.error, IndexError) as error:
        raise RobotError(
            f"Not all motors of the arm answer on {port} ({_first_line(error)}): switch the robot on, check the cable, "
            "or say another --robot.arm_port; relmm-doctor --robot.type=locobot asks every motor."
        ) from error
    return bus


def load_of(joints: FloatArray) -> FloatArray:
    """What gravity does to each joint, as a share of what it does to the arm stretched out level; shape (5,)."""
    corners = arm_forward(joints)
    forward = np.array([np.cos(joints[0]), np.sin(joints[0])])
    reach = (corners[:, :2] - corners[0, :2]) @ forward  # m, of elbow, wrist and tool, before the shoulder
    tool = reach[3]
    return np.array([0.0, tool, tool - reach[1], tool - reach[2], 0.0]) / 0.5


def error_words(status: int) -> str:
    """What a motor's Hardware_Error_Status says."""
    return ", ".join(text for bit, text in _ERRORS.items() if status & bit) or f"error {status}"


def _first_line(error: BaseException) -> str:
    return " ".join(str(error).split())[:160]
