"""The driver of a Kobuki base: a thread that reads, writes, and lets commands expire."""

from __future__ import annotations

import logging
import math
import socket
import subprocess
import sys
import threading
import time
from dataclasses import dataclass, replace

from relmm.errors import RobotError
from relmm.features import MAX_THETA_VEL, MAX_X_VEL
from relmm.robot.hardware import clock
from relmm.robot.hardware.kobuki_protocol import (
    BATTERY_FULL,
    PERIOD_S,
    Feedback,
    FrameReader,
    Output,
    Sound,
    base_control,
    decode,
    frame,
    general_output,
    request_versions,
    sound,
)
from relmm.robot.hardware.odometry import Odometry

logger = logging.getLogger(__name__)

COMMAND_S = 0.5  # how long a command lasts
ALIVE_S = 0.5  # s without a packet after which a base counts as lost; the driver of the manufacturer warns after 0.1
_START_S = 5.0  # s to wait for its first packet
_MAX_ACCELERATION = (2.2, 600.0)  # m/s^2 and deg/s^2, as in the simulation
_MAX_BACKWARDS = 0.15  # m/s, blind
_COASTING_S = 0.3  # that it takes to stand still
_CHUNK = 65_536
_DRIVING, _STANDING = Output.POWER | Output.LED1_GREEN | Output.LED2_GREEN, Output.POWER | Output.LED1_GREEN
_STOPPED = Output.POWER | Output.LED1_RED | Output.LED2_RED


@dataclass(frozen=True)
class BaseState:
    """What a base tells, added up.

    Attributes:
        packets: how many have come.
        time: when the last one came, s of `clock.now`.
        travelled: m since the start; backwards counts negative.
        heading: degrees since the start, positive = left, not wrapped.
        bumper, cliff, wheel_drop, over_current, charger, buttons: as `Feedback`, of the last packet.
        battery: V, smoothed over a second: it drops for a moment when the motors start.
        bumped: bits of the bumper that were pressed at any time since `Kobuki.forget_bumps`.
        firmware: its version, None before it has told.
    """

    packets: int = 0
    time: float = float("-inf")
    travelled: float = 0.0
    heading: float = 0.0
    bumper: int = 0
    cliff: int = 0
    wheel_drop: int = 0
    over_current: int = 0
    charger: int = 0
    buttons: int = 0
    battery: float = BATTERY_FULL
    bumped: int = 0
    firmware: tuple[int, int, int] | None = None


class Kobuki:
    """A base that moves only as long as it is told to.

    A command lasts 0.5 s. What the bumper, a cliff or a wheel in the air ends is over at once, and as long as these
    last nothing goes towards them. A process of its own (`relmm.robot.hardware.guard`) stops the base when this one
    cannot.

    Args:
        port: its device.
        wheel_scale: true distance by the one its encoders tell.
        dry: the base is told to stand still, whatever it should do.
    """

    def __init__(self, port: str, wheel_scale: float = 1.0, dry: bool = False) -> None:
        self.port = port
        self._dry = dry
        self._lock = threading.Lock()
        self._state, self._odometry, self._reader = BaseState(), Odometry(wheel_scale), FrameReader()
        self._goal, self._expires = (0.0, 0.0), 0.0  # m/s and deg/s
        self._velocity = (0.0, 0.0)
        self._moved = float("-inf")  # when it was last told to move
        self._blocked = False  # whether the goal was dropped because of what the base met
        self._extra = [request_versions()]  # sub-payloads to send once
        self._open = True
        self._program, self._guard = self._start_guard()
        self._thread = threading.Thread(target=self._run, name=f"Kobuki({port})", daemon=True)
        self._thread.start()

    # --- For the body ------------------------------------------------------------------------------------
    def wait_until_there(self) -> None:
        """Wait for the first packet.

        Raises:
            RobotError: none has come.
        """
        until = time.monotonic() + _START_S  # our time: it is the guard's process that takes so long to start
        while self.state().packets == 0:
            if time.monotonic() > until:
                raise RobotError(
                    f"The base does not answer on {self.port}: switch it on, plug it in, or say another "
                    "--robot.base_port (relmm-doctor --robot.type=locobot looks for it)."
                )
            clock.sleep(PERIOD_S)

    def firmware(self) -> tuple[int, int, int] | None:
        """Version of its firmware, which it was asked for; None if it does not tell within a second."""
        until = clock.now() + 1.0
        while self.state().firmware is None and clock.now() < until:
            clock.sleep(PERIOD_S)
        return self.state().firmware

    def state(self) -> BaseState:
        """What it told last."""
        with self._lock:
            return self._state

    @property
    def alive(self) -> bool:
        """Whether packets come."""
        return clock.now() - self.state().time < ALIVE_S

    @property
    def standing(self) -> bool:
        """Whether it is told to stand still."""
        with self._lock:
            return self._velocity == self._goal == (0.0, 0.0)

    def drive(self, x_vel: float, theta_vel: float) -> None:
        """Approach a speed for 0.5 s, at most; m/s and deg/s, clamped to what is allowed."""
        goal = (_clamp(x_vel, -_MAX_BACKWARDS, MAX_X_VEL), _clamp(theta_vel, -MAX_THETA_VEL, MAX_THETA_VEL))
        with self._lock:
            self._goal, self._expires, self._blocked = goal, clock.now() + COMMAND_S, False

    def stop(self) -> None:
        """Stop at once."""
        with self._lock:
            self._halt()
            self._send_command()

    def forget_bumps(self) -> None:
        """Begin to collect anew what is pressed."""
        with self._lock:
            self._state = replace(self._state, bumped=self._state.bumper)

    def play(self, tune: Sound) -> None:
        """Play a tune, with the next command."""
        with self._lock:
            self._extra.append(sound(tune))

    def close(self) -> None:
        """Stop, and let go of the port; the guard stops the base once more when this end of its socket closes."""
        with self._lock:
            if not self._open:
                return
            self._halt()
            self._send_command()
            self._open = False
        self._thread.join()
        self._program.close()
        self._guard.wait()

    # --- The thread --------------------------------------------------------------------------------------
    def _run(self) -> None:
        due = clock.now()
        while self._open:
            self._program.settimeout(min(max(due - clock.now(), 1e-3), PERIOD_S))
            try:
                data = self._program.recv(_CHUNK)
            except TimeoutError:
                data = None
            except OSError:
                data = b""
            if data == b"":
                self._replace_guard()
            with self._lock:
                for payload in self._reader.feed(data or b""):
                    self._take(decode(payload))
                if not self._open:
                    break
                if clock.now() >= due:
                    due = clock.now() + PERIOD_S
                    self._approach_goal()
                    self._send_command()
                elif data is None:  # the guard takes silence for the end of this program
                    self._send_command()

    def _take(self, feedback: Feedback | None) -> None:
        if feedback is None:
            return
        now, before = clock.now(), self._state
        if before.packets and now - before.time > ALIVE_S:
            self._odometry.forget_position()  # it may have been switched off, and counts from 0 again
            self._extra.append(request_versions())
        self._odometry.update(feedback, now - self._moved < _COASTING_S)
        self._state = BaseState(
            packets=before.packets + 1,
            time=now,
            travelled=self._odometry.travelled,
            heading=self._odometry.heading,
            bumper=feedback.bumper,
            cliff=feedback.cliff,
            wheel_drop=feedback.wheel_drop,
            over_current=feedback.over_current,
            charger=feedback.charger,
            buttons=feedback.buttons,
            battery=_smoothed(before, feedback.battery),
            bumped=before.bumped | feedback.bumper,
            firmware=feedback.firmware or before.firmware,
        )
        if not self._allows(self._goal) or not self._allows(self._velocity):
            self._halt()
            self._blocked = True
            self._send_command()  # not at the next period: at once

    def _allows(self, velocity: tuple[float, float]) -> bool:
        state = self._state
        if state.wheel_drop or state.over_current:
            return velocity == (0.0, 0.0)
        return velocity[0] <= 0.0 or not (state.bumper or state.cliff)

    def _approach_goal(self) -> None:
        now = clock.now()
        if now > self._expires or now - self._state.time > ALIVE_S or not self._allows(self._goal):
            self._halt()
        change = (limit * PERIOD_S for limit in _MAX_ACCELERATION)
        forward, turn = (
            value + _clamp(goal - value, -most, most)
            for value, goal, most in zip(self._velocity, self._goal, change, strict=True)
        )
        self._velocity = forward, turn

    def _halt(self) -> None:
        self._goal = self._velocity = (0.0, 0.0)

    def _send_command(self) -> None:
        moving = self._velocity != (0.0, 0.0)
        if moving:
            self._moved = clock.now()
        lights = _STOPPED if self._blocked else _DRIVING if moving else _STANDING
        control = base_control(self._velocity[0], math.radians(self._velocity[1]))
        command = frame(base_control(0.0, 0.0) if self._dry else control, general_output(lights), *self._extra)
        try:
            self._program.send(command)
            self._extra.clear()
        except OSError:
            return  # the thread notices that the guard is gone, and starts another

    # --- The guard ---------------------------------------------------------------------------------------
    def _start_guard(self) -> tuple[socket.socket, subprocess.Popen[bytes]]:
        program, other = socket.socketpair()
        number = other.fileno()
        words = [sys.executable, "-m", "relmm.robot.hardware.guard", self.port, str(number)]
        # In a session of its own: Ctrl-C and Ctrl-Z in the terminal reach the program only.
        guard = subprocess.Popen(words, pass_fds=[number], stdin=subprocess.DEVNULL, start_new_session=True)
        other.close()
        return program, guard

    def _replace_guard(self) -> None:
        """Start another guard, whose first act is to stop the base."""
        self._program.close()
        self._guard.wait()
        logger.warning("The process that guards the base has gone; another one stops the base and takes over.")
        with self._lock:
            self._halt()
            self._program, self._guard = self._start_guard()


def _smoothed(before: BaseState, battery: float) -> float:
    return before.battery + (battery - before.battery) * PERIOD_S if before.packets else battery


def _clamp(value: float, low: float, high: float) -> float:
    return min(max(value, low), high)
