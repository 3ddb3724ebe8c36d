from __future__ import annotations

import numpy as np
import pytest
import torch

from relmm.features import DRIVE_PULSE_S, MAX_THETA_VEL, MAX_X_VEL, Skill
from relmm.policies.relmm.driving import STEP_LENGTH, STEP_TURN
from relmm.policies.relmm.memory import FloorGrid, FloorMemory
from relmm.policies.relmm.mind import Mind
from relmm.policies.relmm.planning import Plan, Planner


class Notes(Planner):
    """A planner that notes what it is told."""

    def __init__(self) -> None:
        super().__init__(25.0, 0.2)
        self.thwarted, self.shifts = 0, np.zeros(2)

    def thwart(self) -> None:
        self.thwarted += 1

    def shift(self, by: np.ndarray) -> None:
        self.shifts = self.shifts + by


def plan(forward: float, turn: float) -> Plan:
    here = np.zeros(2)
    return Plan((forward, turn), np.zeros(3), here[None], here, 0.0, False)


@pytest.fixture
def planner() -> Notes:
    return Notes()


@pytest.fixture
def mind(grid: FloorGrid, planner: Notes) -> Mind:
    return Mind(FloorMemory(grid), planner, torch.Generator())


@pytest.mark.parametrize(("forward", "turn"), [(STEP_LENGTH, 0.0), (0.05, -STEP_TURN), (0.0, 0.2)])
def test_a_planned_step_is_an_action_that_leads_there(forward: float, turn: float, mind: Mind) -> None:
    mind.plan = plan(forward, turn)
    action = mind.drive()
    assert action["skill.pos"] == Skill.NAVIGATE
    assert action["x.vel"] * DRIVE_PULSE_S == pytest.approx(forward)
    assert np.radians(action["theta.vel"]) * DRIVE_PULSE_S == pytest.approx(turn)
    assert 0 <= action["x.vel"] <= MAX_X_VEL + 1e-9
    assert abs(action["theta.vel"]) <= MAX_THETA_VEL + 1e-9


def test_time_goes_by_with_navigation_steps_alone(mind: Mind) -> None:
    mind.plan = plan(0.1, 0.0)
    for _ in range(3):
        mind.drive()
    mind.move(np.zeros(3))
    assert mind.floor.steps == 3


@pytest.mark.parametrize(
    ("motion", "thwarted"),
    [
        ((0.1, 0.0, 0.3), False),
        ((0.08, 0.02, 0.35), False),  # wheels slip a little
        ((0.0, 0.0, 0.3), True),  # it did not get on
        ((0.1, 0.0, 1.5), True),  # it was turned away
        ((0.1, 0.0, -0.9), True),
    ],
)
def test_a_step_that_goes_otherwise_than_planned_is_told_once(motion, thwarted, mind: Mind, planner: Notes) -> None:
    mind.plan = plan(0.1, 0.3)
    mind.drive()
    mind.move(np.array(motion))
    assert planner.thwarted == thwarted
    mind.move(np.zeros(3))  # an attempt: nothing was to be driven
    assert planner.thwarted == thwarted
    assert mind.floor.pose == pytest.approx(np.array(motion))


def test_all_places_move_along_with_the_map(mind: Mind, planner: Notes) -> None:
    place = np.array([0.4, -0.3])
    mind.attempted, mind.carry_to = [place.copy()], (place.copy(), np.array([0.1, 0.2, 1.0]))
    before = mind.floor.to_robot(place)
    for _ in range(40):
        mind.move(np.array([0.1, 0.02, 0.0]))
    by = planner.shifts
    assert np.linalg.norm(by) > 1
    assert mind.attempted[0] == pytest.approx(place - by)
    assert mind.carry_to[0] == pytest.approx(place - by)
    assert mind.carry_to[1] == pytest.approx(np.array([0.1, 0.2, 1.0]) - [*by, 0.0])
    assert mind.floor.to_robot(mind.attempted[0]) == pytest.approx(before - [4.0, 0.8])
