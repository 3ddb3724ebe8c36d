"""Episodes without resets: act until something is picked up, carry it elsewhere, and go on from there.

An episode as it is recorded begins with the pseudo-reset after the last success, if there was one (frames of the phase
`PSEUDO_RESET`), goes on with the policy's own frames, and ends with a success or at the step limit. So its last frame
is the only one that is done or truncated.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from lerobot.robots.robot import Robot

from relmm.features import FREE_GRASPS, MAX_THETA_VEL, MAX_X_VEL, Phase, Skill, action_dict
from relmm.learning.actor import TASK, Actor

_PLACE_XY = (0.40, 0.0)  # m, where a pseudo-reset puts the object down, as in the authors' code
_TURN_AWAY_STEPS = 4  # 108 degrees, so that driving on does not push what was just put down


class Recorder(Protocol):
    """Where frames go; `relmm.episodes.EpisodeRecorder` is one."""

    def add_frame(
        self, observation: dict[str, Any], action: dict[str, float], outcome: dict[str, Any], task: str
    ) -> None:
        """Take one frame."""

    def save_episode(self) -> None:
        """End the episode."""


@dataclass(frozen=True)
class EpisodeResult:
    """What happened in one episode.

    Attributes:
        frames: recorded, pseudo-reset included.
        grasps: attempts.
        success: whether it ended with something in the gripper.
    """

    frames: int
    grasps: int
    success: bool


class Collector:
    """Runs a policy on a robot and records its life.

    Args:
        robot: connected.
        actor: the policy.
        recorder: takes the frames.
        clock: seconds on the robot's own clock.
        rng: of the pseudo-resets.
        max_steps: navigation steps after which an episode is cut off; grasp attempts beyond two in a row count, too.
        pseudo_reset_steps: random navigation steps before and after the object is put down (20 in the authors' code).
        should_stop: asked after every frame; the episode is then cut off and saved.
    """

    def __init__(
        self,
        robot: Robot,
        actor: Actor,
        recorder: Recorder,
        clock: Callable[[], float],
        rng: np.random.Generator,
        max_steps: int,
        pseudo_reset_steps: int,
        should_stop: Callable[[], bool],
    ) -> None:
        self._robot, self._actor, self._recorder, self._clock, self._rng = robot, actor, recorder, clock, rng
        self._max_steps, self._pseudo_reset_steps, self._should_stop = max_steps, pseudo_reset_steps, should_stop
        self._observation = robot.get_observation()
        self._frames = self._steps = self._grasps = self._grasps_in_a_row = 0

    def episode(self) -> EpisodeResult:
        """Run and record one episode; what the recorder raises comes through."""
        self._frames = self._steps = self._grasps = self._grasps_in_a_row = 0
        self._actor.reset()
        ended = self._holding and self._pseudo_reset()
        while not ended:
            ended = self._step(self._actor.act(self._observation), Phase.LEARNING)
        self._recorder.save_episode()
        return EpisodeResult(self._frames, self._grasps, self._holding)

    @property
    def _holding(self) -> bool:
        return bool(self._observation["holding.pos"] > 0.5)

    def _pseudo_reset(self) -> bool:
        """Carry what was picked up to somewhere else (paper, "pseudo-reset"); whether the episode was cut off."""
        return any(self._step(action, Phase.PSEUDO_RESET) for action in self._pseudo_reset_actions())

    def _pseudo_reset_actions(self) -> Iterator[dict[str, float]]:
        for _ in range(self._pseudo_reset_steps):
            yield self._anywhere()
        if self._holding:  # it may have been lost on the way
            yield action_dict(Skill.PLACE, x=_PLACE_XY[0], y=_PLACE_XY[1])
        direction = self._rng.choice((-1.0, 1.0))
        for _ in range(_TURN_AWAY_STEPS):
            yield action_dict(theta_vel=direction * MAX_THETA_VEL)
        for _ in range(self._pseudo_reset_steps):
            yield self._anywhere()

    def _anywhere(self) -> dict[str, float]:
        x_vel, theta_vel = self._rng.uniform((0.0, -MAX_THETA_VEL), (MAX_X_VEL, MAX_THETA_VEL))
        return action_dict(x_vel=float(x_vel), theta_vel=float(theta_vel))

    def _step(self, action: dict[str, float], phase: Phase) -> bool:
        """Act, look, record; whether the episode has ended."""
        before, seconds = self._observation, self._clock()
        done_action = self._robot.send_action(action)
        self._observation = self._robot.get_observation()
        grasped = done_action["skill.pos"] == Skill.GRASP
        self._count(grasped, phase)
        success = grasped and self._holding
        truncated = not success and (self._steps >= self._max_steps or self._should_stop())
        outcome = {
            "next.reward": float(success),
            "next.done": success,
            "next.truncated": truncated,
            "next.success": success,
            "complementary_info.phase": int(phase),
            "complementary_info.grasp_probability": self._actor.grasp_probability if phase == Phase.LEARNING else -1.0,
            "complementary_info.robot_time": seconds,
        }
        self._recorder.add_frame(before, done_action, outcome, TASK)
        return success or truncated

    def _count(self, grasped: bool, phase: Phase) -> None:
        self._frames += 1
        self._grasps += grasped
        self._grasps_in_a_row = self._grasps_in_a_row + 1 if grasped else 0
        self._steps += phase == Phase.LEARNING and (not grasped or self._grasps_in_a_row > FREE_GRASPS)
