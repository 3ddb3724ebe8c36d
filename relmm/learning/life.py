"""A robot's life, frame by frame: act, look, judge, and hand the frame to whoever keeps it.

An episode begins with the pseudo-reset after the last success, if there was one, and ends with a success, at a step
limit, or with a checkpoint; where a room is to be cleaned, it ends when that is done, instead of with a success. Its
last frame is the only one that is done or truncated.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from lerobot.robots.robot import Robot

from relmm.features import (
    BASKET_XY,
    BELIEF,
    DRIVE_PULSE_S,
    FREE_GRASPS,
    MOTION_NAMES,
    ODOMETRY,
    PRACTICE_TASK,
    TASK,
    WEIGHTS_STEP,
    FloatArray,
    Phase,
    Skill,
)
from relmm.geometry import moved


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
        steps: that count towards the limit: navigation steps, and attempts beyond two after one.
        picked_up: attempts that picked something up.
        collected: objects put into the basket.
        success: whether it was done when it ended.
    """

    frames: int = 0
    grasps: int = 0
    steps: int = 0
    picked_up: int = 0
    collected: int = 0
    success: bool = False


class Life:
    """Acts on a robot and keeps a record.

    Args:
        robot: connected.
        recorders: take the frames.
        clock: seconds on the robot's own clock.
        max_steps: after which an episode is cut off.
        should_stop: asked after every frame; the episode is then cut off and saved.
        to_collect: how many objects the robot has to put into its basket, by its own count, for an episode to be done;
            None for episodes that are done with the first object picked up.

    Attributes:
        observation: the robot's last.
        pose: x, y (m) and heading (rad, not wrapped) by the robot's own wheels since this life began.
        episode: what has happened in the running episode.
        succeeded: whether the last step picked something up.
        episodes_ended: how many; the result of the newest is in `last_episode`.
        weights_step: steps of the learner elsewhere whose weights act, -1 without one.
    """

    def __init__(
        self,
        robot: Robot,
        recorders: Sequence[Recorder],
        clock: Callable[[], float],
        max_steps: int,
        should_stop: Callable[[], bool],
        to_collect: float | None = None,
    ) -> None:
        self._robot, self._recorders, self._clock = robot, recorders, clock
        self._max_steps, self.should_stop, self._to_collect = max_steps, should_stop, to_collect
        self._task = PRACTICE_TASK if to_collect is None else TASK
        self._grasps_since_drive = 0
        self.observation: dict[str, Any] = robot.get_observation()
        self.pose: FloatArray = np.zeros(3)
        self.episode = EpisodeResult()
        self.succeeded = False
        self.episodes_ended, self.weights_step = 0, -1

    @property
    def holding(self) -> bool:
        """Whether the robot believes that it holds something."""
        return bool(self.observation["holding.pos"] > 0.5)

    def look_again(self) -> None:
        """Take a new observation, after someone else has changed the room."""
        self.observation = self._robot.get_observation()

    def begin_anew(self) -> None:
        """Begin a life in another room: nothing of the last one counts, its odometry included."""
        self.look_again()
        self.pose = np.zeros(3)

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
        self.pose = moved(self.pose, motion_of(self.observation))
        self._count(done_action, phase)
        success = self.succeeded
        done = success if self._to_collect is None else self.episode.collected >= self._to_collect
        truncated = not done and (self.episode.steps >= self._max_steps or self.should_stop())
        outcome = {
            "next.reward": float(success),
            "next.done": done,
            "next.truncated": truncated,
            "next.success": done,
            "complementary_info.phase": int(phase),
            **{f"complementary_info.{name}": (belief or {}).get(name, -1.0) for name in BELIEF},
            **{f"complementary_info.{name}": value for name, value in zip(ODOMETRY, odometry, strict=True)},
            "complementary_info.robot_time": seconds,
            WEIGHTS_STEP: self.weights_step,
        }
        for recorder in self._recorders:
            recorder.add_frame(before, done_action, outcome, self._task)
        if done or truncated:
            for recorder in self._recorders:
                recorder.save_episode()
            self._begin_episode(done)
        return done or truncated

    def cut_episode(self) -> None:
        """End the episode here, if it has any frames: what is recorded and learned then ends with the same one."""
        if self.episode.frames:
            for recorder in self._recorders:
                recorder.cut_episode()
            self._begin_episode(success=False)

    def _count(self, action: dict[str, float], phase: Phase) -> None:
        skill = Skill(int(action["skill.pos"]))
        grasped, placed = skill == Skill.GRASP, skill == Skill.PLACE
        self._grasps_since_drive = 0 if skill == Skill.NAVIGATE else self._grasps_since_drive + grasped
        free = placed or (grasped and self._grasps_since_drive <= FREE_GRASPS)
        self.succeeded = grasped and self.holding
        into_basket = placed and not self.holding and (action["skill_x.pos"], action["skill_y.pos"]) == BASKET_XY
        self.episode.frames += 1
        self.episode.grasps += grasped
        self.episode.steps += phase == Phase.CURRICULUM or (phase == Phase.LEARNING and not free)
        self.episode.picked_up += self.succeeded
        self.episode.collected += into_basket

    def _begin_episode(self, success: bool) -> None:
        self.episode.success = success
        self.last_episode, self.episode = self.episode, EpisodeResult()
        self.episodes_ended += 1
        self._grasps_since_drive = 0


def motion_of(observation: dict[str, Any]) -> FloatArray:
    """Forward, left (m) and turn (rad) of the last skill."""
    forward, left, turn = (observation[name] * DRIVE_PULSE_S for name in MOTION_NAMES)
    return np.array([forward, left, math.radians(turn)])
