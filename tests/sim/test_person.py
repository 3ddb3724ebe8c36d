from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from relmm.errors import ConfigError
from relmm.features import in_grasp_area
from relmm.sim.config_locobot_sim import LocobotSimConfig
from relmm.sim.locobot_sim import LocobotSim
from relmm.sim.person import Person


@pytest.fixture
def robot() -> Iterator[LocobotSim]:
    with LocobotSim(LocobotSimConfig(id="test", room="obstacles", num_objects=4, seed=0)) as robot:
        yield robot


@pytest.fixture
def person(robot: LocobotSim) -> Person:
    return Person(robot, np.random.default_rng(0))


def lay(robot: LocobotSim, index: int, x: float, y: float) -> None:
    robot.body.put_object(index, robot.body.truth.in_robot_frame(np.array([x, y])))


def test_places_of_the_room_are_told_in_the_robots_frame(robot: LocobotSim) -> None:
    truth = robot.body.truth
    expected = truth.objects_in_robot_frame()[:, :2]
    told = np.array([truth.in_robot_frame(xy) for xy in truth.objects()[:, :2]])
    assert told == pytest.approx(expected, abs=1e-3)


def test_what_lies_at_walls_and_obstacles_is_laid_elsewhere_and_nothing_else(robot: LocobotSim, person: Person) -> None:
    lay(robot, 0, 1.48, -0.2)  # at a wall
    lay(robot, 2, -0.32, 0.5)  # at a box
    robot.get_observation()
    before = robot.body.truth.objects()
    assert person.tidy() == 2
    after = robot.body.truth.objects()
    moved = np.hypot(*(after - before)[:, :2].T) > 0.02
    assert moved.tolist() == [True, False, True, False]
    assert robot.body.room.is_clear(after[:, :2]).all()
    assert person.tidy() == 0


def test_what_is_carried_stays_where_it_is(robot: LocobotSim, person: Person) -> None:
    lay(robot, 0, 1.48, -0.2)
    robot.body.data.xpos[robot.body.truth.object_ids[0], 2] = 0.2  # in the gripper, as far as anybody sees
    assert robot.body.truth.carried().tolist() == [0]
    assert person.tidy() == 0


def test_person_puts_the_nearest_object_into_reach(robot: LocobotSim, person: Person) -> None:
    assert person.put_in_reach()
    assert any(in_grasp_area(x, y) for x, y, _ in robot.body.truth.objects_in_robot_frame())
    assert not person.put_in_reach()


def test_a_negative_number_of_steps_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"robot\.tidy_every is -1, but must be at least 0"):
        LocobotSimConfig(id="test", tidy_every=-1)
