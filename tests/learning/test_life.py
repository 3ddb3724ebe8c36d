"""What a life records about each frame, on a robot whose motions are scripted."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

from relmm.features import BELIEF, DRIVE_PULSE_S, MOTION_NAMES, ODOMETRY, Phase, action_dict, outcome_features
from relmm.learning.life import Life

Motion = tuple[float, float, float]  # m forward, m left, degrees


class ScriptedRobot:
    """Its wheels report one motion after each action; the first is from before the life began."""

    def __init__(self, motions: Sequence[Motion]) -> None:
        self._motions = [(9.0, 9.0, 99.0), *motions]
        self._actions = 0

    def get_observation(self) -> dict[str, float]:
        motion = self._motions[self._actions]
        velocities = {name: value / DRIVE_PULSE_S for name, value in zip(MOTION_NAMES, motion, strict=True)}
        return {"holding.pos": 0.0, **velocities}

    def send_action(self, action: dict[str, float]) -> dict[str, float]:
        self._actions += 1
        return action


class Outcomes:
    def __init__(self) -> None:
        self.rows: list[dict[str, Any]] = []

    def add_frame(self, observation: Any, action: Any, outcome: dict[str, Any], task: str) -> None:
        self.rows.append({name.removeprefix("complementary_info."): value for name, value in outcome.items()})

    def save_episode(self) -> None:
        pass

    def odometry(self) -> list[list[float]]:
        return [[row[name] for name in ODOMETRY] for row in self.rows]


def begin(motions: Sequence[Motion]) -> tuple[Life, Outcomes]:
    recorder, clock = Outcomes(), itertools.count()
    robot: Any = ScriptedRobot(motions)
    return Life(robot, [recorder], lambda: float(next(clock)), max_steps=1000, should_stop=lambda: False), recorder


def live(motions: Sequence[Motion]) -> tuple[Life, Outcomes]:
    life, recorder = begin(motions)
    for _ in motions:
        life.step(action_dict(), Phase.LEARNING)
    return life, recorder


# --- Odometry ------------------------------------------------------------------------------------------------
def test_the_pose_of_a_frame_is_where_the_robot_was_when_it_began() -> None:
    life, recorder = live([(0.1, 0.0, 90.0)] * 4)
    expected = [[0, 0, 0], [0.1, 0, 90], [0.1, 0.1, 180], [0, 0.1, 270]]
    np.testing.assert_allclose(recorder.odometry(), expected, atol=1e-12)
    np.testing.assert_allclose(life.pose, [0, 0, 2 * np.pi], atol=1e-12)  # m, m and rad


def test_a_step_to_the_left_is_seen_from_where_it_began() -> None:
    life, recorder = live([(0.0, 0.0, 30.0), (0.2, 0.1, 0.0), (0.2, -0.1, -30.0)])
    cos, sin = np.cos(np.pi / 6), np.sin(np.pi / 6)
    np.testing.assert_allclose(recorder.odometry()[2], [0.2 * cos - 0.1 * sin, 0.2 * sin + 0.1 * cos, 30])
    np.testing.assert_allclose(life.pose, [0.4 * cos, 0.4 * sin, 0], atol=1e-12)


@pytest.mark.parametrize("turn", [100.0, -100.0])
def test_headings_are_not_wrapped(turn: float) -> None:
    _, recorder = live([(0.0, 0.0, turn)] * 6)
    assert [heading for _, _, heading in recorder.odometry()] == pytest.approx([turn * i for i in range(6)])


def test_a_second_look_is_no_second_motion() -> None:
    life, recorder = begin([(0.1, 0.0, 0.0)] * 2)
    for _ in range(2):
        life.look_again()
        life.step(action_dict(), Phase.PSEUDO_RESET)
        life.look_again()
    assert life.pose == pytest.approx([0.2, 0, 0])
    assert recorder.odometry()[1] == pytest.approx([0.1, 0, 0])


# --- Beliefs -------------------------------------------------------------------------------------------------
def test_what_the_policy_believed_is_recorded_and_minus_one_where_it_has_no_opinion() -> None:
    life, recorder = begin([(0.0, 0.0, 0.0)] * 4)
    beliefs = [dict(zip(BELIEF, (0.5, 0.25, 0.125), strict=True)), {"grasp_probability": 0.75}, {}, None]
    for belief in beliefs:
        life.step(action_dict(), Phase.LEARNING, belief)
    recorded = [[row[name] for name in BELIEF] for row in recorder.rows]
    assert recorded == [[0.5, 0.25, 0.125], [0.75, -1, -1], [-1, -1, -1], [-1, -1, -1]]


def test_a_frame_has_all_columns_and_no_others() -> None:
    life, recorder = begin([(0.0, 0.0, 0.0)])
    life.step(action_dict(), Phase.LEARNING, {"grasp_probability": 0.5, "something_else": 1.0})
    assert recorder.rows[0].keys() == {name.removeprefix("complementary_info.") for name in outcome_features()}
