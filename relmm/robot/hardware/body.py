"""The real LoCoBot's body: base, arm and camera as one `relmm.robot.body.Body`."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from relmm.errors import RobotError
from relmm.features import FloatArray
from relmm.geometry import CameraGeometry, arm_forward, arm_inverse
from relmm.robot.body import BodyState
from relmm.robot.hardware import clock
from relmm.robot.hardware.arm_safety import find_way
from relmm.robot.hardware.calibration import Calibration
from relmm.robot.hardware.d435 import D435, NO_PICTURES
from relmm.robot.hardware.kobuki import Kobuki
from relmm.robot.hardware.kobuki_protocol import BATTERY_CHARGED, BATTERY_EMPTY, BATTERY_LOW, Charger, Sound
from relmm.robot.hardware.widowx import ArmState, WidowX
from relmm.robot.skills import REST_POSE

logger = logging.getLogger(__name__)

_SLICE_S = 0.02  # between looks at what may have gone wrong
_MAX_LATE_S, _LEAST_S = 0.1, 0.001  # that a wait makes up for, and that are worth a sleep
_PAN, _TILT = 0.0, 0.825  # rad, as the authors had it
_HEAD_S, _RISE_S = 1.2, 1.5
_POINTS_DOWN = 1.4  # rad, of the gripper's pitch
_CHARGE_POLL_S = 1.0
_RECONNECT_S = 60.0  # to wait for a base whose cable is out


class LocobotBody:
    """See `relmm.robot.body.Body`; its time is the clock's.

    Args:
        base: driver of the base.
        arm: driver of the arm.
        camera: driver of the camera.
        view: how pictures look; its position is where the camera really is.
        calibration: of this robot.
        say: shows what it would do, in a dry run; None for a robot that does it.
    """

    def __init__(
        self,
        base: Kobuki,
        arm: WidowX,
        camera: D435,
        view: CameraGeometry,
        calibration: Calibration,
        say: Callable[[str], None] | None = None,
    ) -> None:
        self.base, self.arm, self.eye = base, arm, camera
        self.camera = replace(view, position=(*view.position[:2], calibration.camera_height))
        self._say, self._calibration = say, calibration
        self._start = self._due = clock.now()  # `_due`: when the last wait was to end
        self._arm_state: tuple[float, ArmState] | None = None

    def start(self) -> None:
        """Check everything, take hold of the arm, and look at the floor.

        Raises:
            RobotError: something is wrong; says what to do.
        """
        self.base.wait_until_there()
        battery = self.base.state().battery
        if battery < BATTERY_LOW:
            raise RobotError(
                f"The battery is at {battery:.1f} V, and {BATTERY_LOW} V are needed to begin: charge it first."
            )
        self.base.play(Sound.ON)
        self.arm.configure()
        self.arm.look(_PAN, _TILT)
        self.wait(_HEAD_S)
        for pose in find_way(self.arm.state().joints, REST_POSE):  # a limp arm may have been put anywhere
            self.arm.move(pose, _RISE_S)
            self.wait(_RISE_S)

    @property
    def needs_charging(self) -> bool:
        """Whether the battery is low."""
        return self.base.state().battery < BATTERY_LOW

    def await_charge(self, should_stop: Callable[[], bool]) -> None:
        """Lie down until the battery is full and the charger is pulled out again, or until told to stop."""
        self.base.stop()
        self.base.play(Sound.RECHARGE)
        self.arm.lie_down(clock.sleep)
        logger.warning(
            "The battery is at %.1f V: charge the robot. It goes on by itself at %.1f V, without the charger.",
            *(self.base.state().battery, BATTERY_CHARGED),
        )
        while not should_stop():
            state = self.base.state()
            if self.base.alive and state.battery >= BATTERY_CHARGED and state.charger == Charger.NONE:
                break
            clock.sleep(_CHARGE_POLL_S)
        self.base.play(Sound.ON)
        self.arm.configure()
        self._due = clock.now()

    # --- Body --------------------------------------------------------------------------------------------
    def drive(self, x_vel: float, theta_vel: float) -> None:
        """See `Body.drive`; without another command the base stops after 0.5 s."""
        self._tell(f"drive at {x_vel:.2f} m/s, turn at {theta_vel:.0f} deg/s")
        self._due = clock.now()
        self.base.drive(x_vel, theta_vel)

    def move_arm(self, joints: FloatArray, seconds: float) -> None:
        """See `Body.move_arm`.

        Raises:
            RobotError: the way there is not free of the robot itself or the floor.
        """
        self._tell(f"move the arm to {np.degrees(joints).round().tolist()} degrees in {seconds:.1f} s")
        self._arm_state = None
        self.arm.move(self._corrected(joints), seconds)
        self._due = clock.now()

    def set_gripper(self, opening: float) -> None:
        """See `Body.set_gripper`."""
        self._tell(f"move the fingers to {opening * 1000:.0f} mm" if opening >= 0 else "close the fingers")
        self.arm.set_gripper(opening)

    def state(self) -> BodyState:
        """See `Body.state`."""
        base, arm = self.base.state(), self._read_arm()
        return BodyState(
            time=clock.now() - self._start,
            travelled=base.travelled,
            heading=base.heading,
            joints=arm.joints,
            joint_goal=arm.goal,
            gripper=max(arm.opening, 0.0),
            bumper=base.bumped,
        )

    def capture(self) -> tuple[NDArray[np.uint8], NDArray[np.uint16]]:
        """See `Body.capture`."""
        return self.eye.capture()

    def wait(self, seconds: float) -> None:
        """Let time pass, and watch base, arm, gripper and camera meanwhile.

        Raises:
            RobotError: one of them is lost or broken; the base stands still then.
        """
        self.base.forget_bumps()
        # From the end of the last wait on, so that a row of waits takes no longer than it says; reading takes time too.
        late = clock.now() - self._due
        self._due += seconds + (late if late > _MAX_LATE_S else 0.0)
        try:
            self._watch()
            while (left := self._due - clock.now()) > _LEAST_S:
                clock.sleep(min(left, _SLICE_S))
                self._watch()
        except RobotError:
            self.base.stop()
            self.base.play(Sound.ERROR)
            raise
        self._arm_state = None

    def stop(self) -> None:
        """See `Body.stop`."""
        self.base.stop()
        self._arm_state = None
        self.arm.hold()

    def close(self) -> None:
        """Stop the base, lay the arm down, and let go of all three, whatever state they are in."""
        self.base.stop()
        with contextlib.ExitStack() as stack:  # each of them, even if another one fails
            stack.callback(self.base.close)
            stack.callback(self.arm.close)
            stack.callback(self.eye.close)
            try:
                self.arm.lie_down(clock.sleep)
            except RobotError as error:
                logger.warning("The arm was not laid down: %s", error)

    def _corrected(self, joints: FloatArray) -> FloatArray:
        """The same pose, shifted by what the calibration's touches have shown; only where the gripper points down."""
        pitch = float(joints[1:4].sum())
        if self._calibration.grasp == Calibration().grasp or pitch < _POINTS_DOWN:
            return joints
        x, y, z = arm_forward(joints)[3]
        return arm_inverse(*self._calibration.corrected(x, y), z, pitch, float(joints[4]))

    # --- Watching ----------------------------------------------------------------------------------------
    def _watch(self) -> None:
        if not self.base.alive:
            self._wait_for_base()
        if not self.eye.alive:
            raise RobotError(NO_PICTURES)
        if (battery := self.base.state().battery) < BATTERY_EMPTY:
            raise RobotError(f"The battery is at {battery:.1f} V, nearly empty: charge the robot, and start again.")
        self.arm.check_health()
        self.arm.update()

    def _wait_for_base(self) -> None:
        """The driver opens the port again by itself, and stops the base first.

        Raises:
            RobotError: it did not come back.
        """
        logger.warning("The base on %s is silent: check its cable and its switch. The robot waits.", self.base.port)
        until = clock.now() + _RECONNECT_S
        while not self.base.alive:
            if clock.now() > until:
                raise RobotError(f"The base on {self.base.port} has been silent for {_RECONNECT_S:.0f} s: start again.")
            clock.sleep(_SLICE_S)
        logger.warning("The base is back.")

    def _read_arm(self) -> ArmState:
        """The arm now; several looks at one moment ask its motors once."""
        now = clock.now()
        if self._arm_state is None or now - self._arm_state[0] > _SLICE_S / 2:
            self._arm_state = (now, self.arm.state())
        return self._arm_state[1]

    def _tell(self, what: str) -> None:
        if self._say is not None:
            self._say(what)
