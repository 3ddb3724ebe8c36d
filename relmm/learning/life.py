"""A robot's life, frame by frame: act, look, judge, and hand the frame to whoever keeps it.

An episode begins with the pseudo-reset after the last success, if there was one, and ends with a success, at a step
limit, or with a checkpoint. Its last frame is the only one that is done or truncated.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from lerobot.robots.robot import Robot

from relmm.features import BELIEF, DRIVE_PULSE_S, FREE_GRASPS, MOTION_NAMES, ODOMETRY, FloatArray, Phase, Skill
from relmm.geometry import moved
from relmm.learning.actor import TASK


class Recorder(Protocol):
    """Where frames go; `relmm.episodes.EpisodeRecorder` and `relmm.policies.learning.Learner` are two."""

    def add_frame(
        self, observation: dict[str, Any], action: dict[str, float], outcome: dict[str, Any], task: str
    ) -> None:
        """Take one frame."""

    def save_episode(self) -> None:
        """End the episode."""

    def cut_episode(self) -> None:
        """End it before it is done."""


@dataclass
class EpisodeResult:
    """What happened in one episode.

    Attributes:
        frames: recorded, pseudo-reset included.
        grasps: attempts.
        steps: that count towards the limit: navigation steps, and attempts beyond two in a row.
        success: whether it ended with something in the gripper.
    """

    frames: int = 0
    grasps: int = 0
    steps: int = 0
    success: bool = False


class Life:
    """Acts on a robot and keeps a record.

    Args:
        robot: connected.
        recorders: take the frames.
        clock: seconds on the robot's own clock.
        max_steps: after which an episode is cut off.
        should_stop: asked after every frame; the episode is then cut off and saved.

    Attributes:
        observation: the robot's last.
        pose: x, y (m) and heading (rad, not wrapped) by the robot's own wheels since this life began.
        episode: what has happened in the running episode.
        succeeded: whether the last step picked something up.
    """

    def __init__(
        self,
        robot: Robot,
        recorders: Sequence[Recorder],
        clock: Callable[[], float],
        max_steps: int,
        should_stop: Callable[[], bool],
    ) -> None:
        self._robot, self._recorders, self._clock = robot, recorders, clock
        self._max_steps, self.should_stop = max_steps, should_stop
        self._grasps_in_a_row = 0
        self.observation: dict[str, Any] = robot.get_observation()
        self.pose: FloatArray = np.zeros(3)
        self.episode = EpisodeResult()
        self.succeeded = False

    @property
    def holding(self) -> bool:
        """Whether the robot believes that it holds something."""
        return bool(self.observation["holding.pos"] > 0.5)

    def look_again(self) -> None:
        """Take a new observation, after someone else has changed the room."""
        self.observation = self._robot.get_observation()

    def step(self, action: dict[str, float], phase: Phase, belief: Mapping[str, float] | None = None) -> bool:
        """Act, look, record.

        Args:
            action: one skill.
            phase: why.
            belief: what the action was based on, by the names of `relmm.features.BELIEF`; those missing count as -1.

        Returns:
            Whether the episode has ended with this frame; its result is then in `last_episode`.
        """
        before, seconds = self.observation, self._clock()
        odometry = (*self.pose[:2].tolist(), math.degrees(self.pose[2]))
        done_action = self._robot.send_action(action)
        self.observation = self._robot.get_observation()
        self.pose = moved(self.pose, _motion(self.observation))
        grasped = done_action["skill.pos"] == Skill.GRASP
        self._count(grasped, phase)
        success = self.succeeded = grasped and self.holding
        truncated = not success and (self.episode.steps >= self._max_steps or self.should_stop())
        outcome = {
            "next.reward": float(success),
            "next.done": success,
            "next.truncated": truncated,
            "next.success": success,
            "complementary_info.phase": int(phase),
            **{f"complementary_info.{name}": (belief or {}).get(name, -1.0) for name in BELIEF},
            **{f"complementary_info.{name}": value for name, value in zip(ODOMETRY, odometry, strict=True)},
            "complementary_info.robot_time": seconds,
        }
        for recorder in self._recorders:
            recorder.add_frame(before, done_action, outcome, TASK)
        if success or truncated:
            for recorder in self._recorders:
                recorder.save_episode()
            self._begin_episode(success)
        return success or truncated

    def cut_episode(self) -> None:
        """End the episode here, if it has any frames: what is recorded and learned then ends with the same one."""
        if self.episode.frames:
            for recorder in self._recorders:
                recorder.cut_episode()
            self._begin_episode(success=False)

    def _count(self, grasped: bool, phase: Phase) -> None:
        self._grasps_in_a_row = self._grasps_in_a_row + 1 if grasped else 0
        counts = phase == Phase.CURRICULUM or (phase == Phase.LEARNING and not 0 < self._grasps_in_a_row <= FREE_GRASPS)
        self.episode.frames += 1
        self.episode.grasps += grasped
        self.episode.steps += counts

    def _begin_episode(self, success: bool) -> None:
        self.episode.success = success
        self.last_episode, self.episode = self.episode, EpisodeResult()
        self._grasps_in_a_row = 0


def _motion(observation: dict[str, Any]) -> FloatArray:
    """Forward, left (m) and turn (rad) of the last skill."""
    forward, left, turn = (observation[name] * DRIVE_PULSE_S for name in MOTION_NAMES)
    return np.array([forward, left, math.radians(turn)])
