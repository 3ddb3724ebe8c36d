"""The LoCoBot as a LeRobot `Robot`, over any body."""

from __future__ import annotations

import logging
import math
import weakref
from abc import abstractmethod
from collections.abc import Callable
from typing import Any, ClassVar

import numpy as np
from lerobot.robots.config import RobotConfig
from lerobot.robots.robot import Robot

from relmm.errors import RobotError
from relmm.features import (
    ACTION_NAMES,
    BASKET_XY,
    DRIVE_PULSE_S,
    FRONT,
    FRONT_DEPTH,
    GRASP_X,
    GRASP_Y,
    IMAGE_SIZE,
    MAX_THETA_VEL,
    MAX_X_VEL,
    STATE_NAMES,
    Skill,
    action_dict,
)
from relmm.robot.body import Body
from relmm.robot.skills import Skills

logger = logging.getLogger(__name__)

_SKILLS_STREAM = 1  # keeps the skills' random numbers apart from those that scatter the objects by the same seed
_BASKET_RADIUS = 0.05  # m; a place this near to the basket's middle goes into the basket


class LocobotRobot(Robot):
    """Turns LeRobot's actions into skills, and the body's sensors into LeRobot's observations.

    One action is one blocking skill: a navigation step of 0.5 s, a grasp attempt or a placement.

    Args:
        config: its LeRobot configuration.
        depth: whether observations hold the depth picture.
        seed: of the robot's own choices (the way it turns in front of an obstacle).
    """

    def __init__(self, config: RobotConfig, depth: bool, seed: int) -> None:
        super().__init__(config)
        self.cameras: dict[str, Any] = {}  # LeRobot's commands count them; ours belongs to the body
        self._depth = depth
        self._seed = seed
        self._body: Body | None = None
        self._skills: Skills | None = None

    @abstractmethod
    def make_body(self) -> Body:
        """Start the body, ready to move."""

    # --- Features ----------------------------------------------------------------------------------------
    @property
    def observation_features(self) -> dict[str, Any]:
        """Names with `float`, or the shape of a picture."""
        features: dict[str, Any] = dict.fromkeys(STATE_NAMES, float)
        features[FRONT] = (IMAGE_SIZE, IMAGE_SIZE, 3)
        if self._depth:
            features[FRONT_DEPTH] = (IMAGE_SIZE, IMAGE_SIZE, 1)
        return features

    @property
    def action_features(self) -> dict[str, Any]:
        """Names with `float`."""
        return dict.fromkeys(ACTION_NAMES, float)

    _connected: ClassVar[weakref.WeakSet[LocobotRobot]] = weakref.WeakSet()

    @classmethod
    def connected(cls) -> list[LocobotRobot]:
        """The LoCoBots that are connected in this process."""
        return [robot for robot in cls._connected if robot.is_connected]

    # --- Connection --------------------------------------------------------------------------------------
    @property
    def is_connected(self) -> bool:
        """Whether the body is running."""
        return self._body is not None

    @property
    def is_calibrated(self) -> bool:
        """Always: nothing needs calibrating."""
        return True

    def calibrate(self) -> None:
        """Nothing to do."""

    def configure(self) -> None:
        """Nothing to do."""

    def connect(self, calibrate: bool = True) -> None:
        """Start the body and fold the arm.

        Raises:
            RobotError: it is connected already.
        """
        if self._body is not None:
            raise RobotError(f"{self} is connected already: call disconnect() first.")
        self._body = self.make_body()
        self._connected.add(self)
        self.start_skills(self._seed)

    def start_skills(self, seed: int) -> None:
        """Begin a new life: nothing held, the arm at rest, `seed` for the robot's own choices."""
        self._skills = Skills(self.body, np.random.default_rng([seed, _SKILLS_STREAM]))
        self._skills.rest()

    def disconnect(self) -> None:
        """Stop the base, whatever state the robot is in, and let go of the body."""
        body, self._body, self._skills = self._body, None, None
        if body is not None:
            body.close()

    @property
    def body(self) -> Body:
        """The connected body.

        Raises:
            RobotError: not connected.
        """
        if self._body is None:
            raise RobotError(f"{self} is not connected: call connect() first.")
        return self._body

    @property
    def skills(self) -> Skills:
        """The skills over the connected body.

        Raises:
            RobotError: not connected.
        """
        if self._skills is None:
            raise RobotError(f"{self} is not connected: call connect() first.")
        return self._skills

    @property
    def needs_charging(self) -> bool:
        """Whether the robot should not go on without its battery being charged; a simulated one never."""
        return False

    def await_charge(self, should_stop: Callable[[], bool]) -> None:
        """Wait until a person has charged it, or until told to stop; it may stand elsewhere then, and so may things."""

    def seconds(self) -> float:
        """The robot's own clock, s since it was connected."""
        return self.body.state().time

    # --- Observation and action --------------------------------------------------------------------------
    def get_observation(self) -> dict[str, Any]:
        """The sensors now: `STATE_NAMES` as floats and the pictures as arrays."""
        state, skills = self.body.state(), self.skills
        rgb, depth = skills.picture()
        values = [
            *skills.motion() / DRIVE_PULSE_S,
            *np.degrees(state.joints),
            state.gripper,
            float(skills.holding),
            float(skills.bumper),
            *skills.scan(),
        ]
        observation: dict[str, Any] = dict(zip(STATE_NAMES, map(float, values), strict=True))
        observation[FRONT] = rgb
        if self._depth:
            observation[FRONT_DEPTH] = depth[..., None]
        return observation

    def send_action(self, action: dict[str, Any]) -> dict[str, float]:
        """Run one skill to its end.

        Args:
            action: by `ACTION_NAMES`; what is missing counts as 0, so that commands for the joints alone (LeRobot's
                rollout sends them when it ends) stop the robot.

        Returns:
            What was really done: clipped to the ranges of `relmm.features`; a grasp with a full gripper and a placement
            with an empty one, or where something is in the arm's way, become a navigation step that stands still.

        Raises:
            RobotError: a value that is not a finite number. Nothing has moved then.
        """
        values = {name: float(action.get(name, 0.0)) for name in ACTION_NAMES}
        if not all(math.isfinite(value) for value in values.values()):
            raise RobotError(f"An action must hold finite numbers, not {values}: check the policy that sent it.")
        if not any(name in action for name in ACTION_NAMES):
            self.body.stop()
            return action_dict()
        return self._run(_skill(values["skill.pos"]), values)

    def _run(self, skill: Skill, values: dict[str, float]) -> dict[str, float]:
        holding = self.skills.holding
        if skill == Skill.GRASP and not holding:
            x, y = _clip(values["skill_x.pos"], GRASP_X), _clip(values["skill_y.pos"], GRASP_Y)
            self.skills.grasp(x, y)
            return action_dict(skill, x=x, y=y)
        if skill == Skill.PLACE and holding:
            return self._place(values["skill_x.pos"], values["skill_y.pos"])
        if skill != Skill.NAVIGATE:
            # No warning: a learner that tries things out meets it at every third step, and is told what was done.
            logger.info("Nothing was %s: the gripper %s.", *_refusal(skill))
            values = action_dict()
        x_vel = _clip(values["x.vel"], (0.0, MAX_X_VEL))
        theta_vel = _clip(values["theta.vel"], (-MAX_THETA_VEL, MAX_THETA_VEL))
        self.skills.navigate(x_vel, theta_vel)
        return action_dict(x_vel=x_vel, theta_vel=theta_vel)

    def _place(self, x: float, y: float) -> dict[str, float]:
        if math.hypot(x - BASKET_XY[0], y - BASKET_XY[1]) < _BASKET_RADIUS:
            self.skills.place_in_basket()
            return action_dict(Skill.PLACE, x=BASKET_XY[0], y=BASKET_XY[1])
        x, y = _clip(x, GRASP_X), _clip(y, GRASP_Y)
        self.skills.place(x, y)
        if self.skills.holding:
            logger.warning("Nothing was placed: something is in the arm's way.")
            self.skills.navigate(0.0, 0.0)  # what is reported is what happens
            return action_dict()
        return action_dict(Skill.PLACE, x=x, y=y)


def _skill(value: float) -> Skill:
    return Skill(round(_clip(value, (min(Skill), max(Skill)))))


def _refusal(skill: Skill) -> tuple[str, str]:
    return ("grasped", "holds something already") if skill == Skill.GRASP else ("placed", "is empty")


def _clip(value: float, limits: tuple[float, float]) -> float:
    return min(max(value, limits[0]), limits[1])
