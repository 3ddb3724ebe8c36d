"""The LoCoBot's three skills over any body: one navigation step, grasp at (x, y), place at (x, y).

Lengths, heights and the order of motions follow the authors' released code; the success of a grasp is judged from the
gripper and the camera alone.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from relmm.features import BASKET_XY, DRIVE_PULSE_S, MAX_THETA_VEL, NAVIGATION_STEP_S, FloatArray
from relmm.geometry import arm_inverse, moved
from relmm.robot.body import MAX_OPENING, Body
from relmm.robot.sensing import ContactDetector, ObstacleDetector, grips_something, sees_held_object

logger = logging.getLogger(__name__)

_DOWN = np.pi / 2  # rad, tool pitch
# rad; folded a little tighter than the authors': the fingers and what they hold stay inside the base's circle, so that
# the bumper meets a wall before they do, and out of the camera's view.
REST_POSE = arm_inverse(0.15, 0.0, 0.15, pitch=1.3)
# Before the camera, the floor far behind it; and no farther out than needed, or a wall behind an object would be in
# the way of showing what could well be grasped.
PRESENT_POSE = arm_inverse(0.32, 0.0, 0.20, pitch=0.3)
# On the way there; straight from the floor to it the arm would swing 4 cm beyond both.
_RAISED_POSE = arm_inverse(0.30, 0.0, 0.16, pitch=1.0)
_ABOVE_Z, _GRASP_Z, _PLACE_Z = 0.10, 0.014, 0.018  # m, of the point between the pads
_IN_BASKET = arm_inverse(*BASKET_XY, 0.235, pitch=_DOWN)
_OVER_BASKET = arm_inverse(*BASKET_XY, 0.31, pitch=_DOWN)
_BESIDE_BASKET = np.array([0.0, *_OVER_BASKET[1:]])  # the same height in front: the waist turns over the basket's rim
_SQUEEZE = -0.005  # m, an opening that cannot be reached, so that the fingers press with all their force

_WATCH_S = 0.04  # s between looks at the bumper and at what the arm may meet
_WAY_POINTS = (0.25, 0.5, 0.75, 1.0)  # of an arm motion that is looked at beforehand
_REST_ATTEMPTS = 3
_MAX_JOINT_SPEED = 3.0  # rad/s; the motors' limit is pi
_CARRY_JOINT_SPEED = 2.0  # rad/s with something in the gripper; at 3 every tenth thing slips out on its way
_MIN_MOVE_S = 0.36  # s
_BACK_OFF_VEL, _BACK_OFF_S = -0.15, 0.4  # m/s and s, after the bumper was hit
_MAX_TURNS = 14  # navigation steps of turning on the spot, a little over one round


class Skills:
    """Runs skills on a body, keeps its last picture, and remembers whether something is held.

    Args:
        body: simulated or real.
        rng: decides which way to turn in front of an obstacle.
    """

    def __init__(self, body: Body, rng: np.random.Generator) -> None:
        self._body = body
        self._rng = rng
        self._detector = ObstacleDetector(body.camera)
        self._picture: tuple[NDArray[np.uint8], NDArray[np.uint16]] | None = None
        self._grasped = False
        self._closed = False
        state = body.state()
        self._wheels = (state.travelled, state.heading)  # m and degrees, at the last look
        self._motion: FloatArray = np.zeros(3)  # m forward, m left and rad, of the last skill, by the wheels
        self.bumper = 0  # bits pressed during the last skill

    @property
    def holding(self) -> bool:
        """Whether the last grasp was judged a success and the fingers are still kept apart."""
        return self._grasped and grips_something(self._body.state().gripper)

    def picture(self) -> tuple[NDArray[np.uint8], NDArray[np.uint16]]:
        """Colour and depth, as `Body.capture`; taken anew only if time has passed since the last one."""
        if self._picture is None:
            self._picture = self._body.capture()
        return self._picture

    def motion(self) -> FloatArray:
        """How far the wheels moved the base during the last skill: m forward, m left, degrees, shape (3,)."""
        return self._motion * (1.0, 1.0, np.degrees(1.0))

    def scan(self) -> FloatArray:
        """The nearest thing in the way in each direction, see `relmm.features.SCAN_NAMES`."""
        return self._detector.scan(self.picture()[1])

    def forget_picture(self) -> None:
        """Take a new picture next time, because someone else has changed the room. The last motion has been told."""
        self._picture = None
        self._motion = np.zeros(3)

    def rest(self) -> None:
        """Fold the arm for driving."""
        if not any(self._move(REST_POSE) for _ in range(_REST_ATTEMPTS)):
            logger.warning("Something keeps the arm from folding.")

    def navigate(self, x_vel: float, theta_vel: float) -> None:
        """One navigation step: a drive pulse, a brake, and a turn away from what stands in the way.

        Args:
            x_vel: m/s.
            theta_vel: deg/s, positive = left.
        """
        self._begin()
        self._pulse(x_vel, theta_vel)
        bumped = self.bumper != 0
        if bumped:
            self._body.drive(_BACK_OFF_VEL, 0.0)
            self._wait(_BACK_OFF_S)
            self._brake()
        self._turn_until_clear(at_least_once=bumped)

    def grasp(self, x: float, y: float) -> bool:
        """Try to pick up what lies at a point of the floor (m, robot frame), and say whether it worked.

        A failed attempt ends at rest with open fingers, a successful one at rest with the object held. Where something
        stands in the arm's way nothing moves, and where the arm meets something it goes back: the attempt has failed.
        """
        self._begin()
        above = arm_inverse(x, y, _ABOVE_Z, _DOWN)
        if self._obstructs(REST_POSE, above, _RAISED_POSE, PRESENT_POSE):
            return False
        self._open()
        self._grasped = self._close_at(x, y, above) and self._present()
        if not self._grasped:
            self._open()
        self.rest()
        return self.holding

    def place(self, x: float, y: float) -> None:
        """Put the held object down at a point of the floor (m, robot frame).

        It stays held where something stands in the arm's way, or where the arm meets something before it is there.
        """
        self._begin()
        above = arm_inverse(x, y, _ABOVE_Z, _DOWN)
        if self._obstructs(REST_POSE, above):
            return
        if self._move(above):
            self._move(arm_inverse(x, y, _PLACE_Z, _DOWN))
            self._release()
            self._move(above)
        self.rest()

    def place_in_basket(self) -> None:
        """Drop the held object into the basket at the robot's side."""
        self._begin()
        for pose in (_BESIDE_BASKET, _OVER_BASKET, _IN_BASKET):
            self._move(pose)
        self._release()
        for pose in (_OVER_BASKET, _BESIDE_BASKET, REST_POSE):
            self._move(pose)

    def _obstructs(self, *poses: FloatArray) -> bool:
        """Whether the camera sees something on the arm's way through these poses."""
        way = [start + part * (end - start) for start, end in pairwise(poses) for part in _WAY_POINTS]
        return self._detector.obstructs_arm(self.picture()[1], way)

    def _close_at(self, x: float, y: float, above: FloatArray) -> bool:
        """Close the open fingers round what lies there and lift it; whether there is something between them."""
        if not (self._move(above) and self._move(arm_inverse(x, y, _GRASP_Z, _DOWN))):
            return False
        self._body.set_gripper(_SQUEEZE)
        self._closed = True
        self._wait(0.3)
        return self._move(above) and grips_something(self._body.state().gripper)

    def _open(self) -> None:
        self._body.set_gripper(MAX_OPENING)
        self._closed = False

    def _release(self) -> None:
        self._open()
        self._wait(0.3)
        self._grasped = False

    def _present(self) -> bool:
        """Lift the gripper into view and look whether something is between the pads."""
        arrived = self._move(_RAISED_POSE) and self._move(PRESENT_POSE)
        state = self._body.state()
        return arrived and sees_held_object(self.picture()[1], self._body.camera, state.joints, state.gripper)

    def _turn_until_clear(self, at_least_once: bool) -> None:
        direction = 0.0
        for turn in range(_MAX_TURNS):
            if not self._detector.obstructed(self.picture()[1]) and not (at_least_once and turn == 0):
                return
            direction = direction or float(self._rng.choice((-1.0, 1.0)))
            self._pulse(0.0, direction * MAX_THETA_VEL)
        logger.warning("Something obstructs the graspable area in every direction: the robot may be boxed in.")

    def _pulse(self, x_vel: float, theta_vel: float) -> None:
        self._body.drive(x_vel, theta_vel)
        self._watch(DRIVE_PULSE_S, self._bumped if x_vel > 0 else lambda: False)
        self._brake()

    def _bumped(self) -> bool:
        self.bumper |= self._body.state().bumper
        return self.bumper != 0

    def _brake(self) -> None:
        self._body.drive(0.0, 0.0)
        self._wait(NAVIGATION_STEP_S - DRIVE_PULSE_S)

    def _move(self, joints: FloatArray) -> bool:
        """Move the arm as fast as its joints may turn, stop it where it meets resistance; whether it has arrived."""
        state = self._body.state()
        speed = _CARRY_JOINT_SPEED if self._closed and grips_something(state.gripper) else _MAX_JOINT_SPEED
        distance = np.max(np.abs(joints - state.joints))
        seconds = max(1.5 * distance / speed, _MIN_MOVE_S)  # a smooth profile peaks at 1.5 times its mean
        contact = ContactDetector(state)
        self._body.move_arm(joints, seconds)
        stopped = self._watch(seconds, lambda: contact.touches(self._body.state()))
        if stopped:
            self._body.move_arm(self._body.state().joints, _WATCH_S)
        self._wait(0.1)
        return not stopped and not contact.touches(self._body.state())

    def _watch(self, seconds: float, condition: Callable[[], bool]) -> bool:
        """Let time pass until a condition holds; whether it did."""
        for _ in range(math.ceil(seconds / _WATCH_S)):
            self._wait(_WATCH_S)
            if condition():
                return True
        return False

    def _begin(self) -> None:
        self.bumper = 0
        self._motion = np.zeros(3)

    def _wait(self, seconds: float) -> None:
        self._picture = None
        self._body.wait(seconds)
        state, (travelled, heading) = self._body.state(), self._wheels
        forward, turn = state.travelled - travelled, math.radians(state.heading - heading)
        # The way from one end of an arc to the other points half of its turn aside.
        part = np.array([forward * math.cos(turn / 2), forward * math.sin(turn / 2), turn])
        self._motion = moved(self._motion, part)
        self._wheels = (state.travelled, state.heading)
