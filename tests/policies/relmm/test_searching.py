"""Where a robot that sees nothing turns to, and when it goes elsewhere."""

import math

import pytest
import torch

from relmm.features import DRIVE_PULSE_S, MAX_THETA_VEL
from relmm.policies.relmm.encoders import NOTICED, FloorObserver, map_places
from relmm.policies.relmm.searching import Search, nearest_bearing

AWAY = 12


@pytest.mark.parametrize("theta_vel", [MAX_THETA_VEL, -60.0, 100.0])
def test_robot_looks_all_round_before_it_goes_straight_on(theta_vel: float) -> None:
    search, looks = Search(), math.ceil(360 / (abs(theta_vel) * DRIVE_PULSE_S))
    for _ in range(2):
        steps = [search.leaves(None, theta_vel) for _ in range(looks)]
        steps += [search.leaves(None, 0.0) for _ in range(AWAY)]
        assert steps == [False] * (looks - 1) + [True] * AWAY + [False], "and looks again"


def test_what_comes_into_view_begins_the_look_anew() -> None:
    search = Search()
    looks = [search.leaves(None, 90.0) for _ in range(16)]
    assert not any(looks)
    assert not search.leaves(5.0, 90.0)
    assert [search.leaves(None, 90.0) for _ in range(16)] == looks
    assert search.leaves(None, 90.0)
    assert search.leaves(5.0, 0.0), "what is far is often out of sight again with the next turn"


def test_steps_on_the_way_count_since_the_last_wall() -> None:
    search = Search()
    assert [search.leaves(None, 90.0) for _ in range(17)][-1]
    assert all(search.leaves(None, 0.0) for _ in range(5))
    assert search.leaves(None, 450.0)
    assert [search.leaves(None, 0.0) for _ in range(AWAY)] == [True] * (AWAY - 1) + [False]


def test_robot_that_does_not_turn_has_not_looked_round() -> None:
    search = Search()
    assert not any(search.leaves(None, 0.0) for _ in range(100))


@pytest.mark.parametrize(
    ("bearing", "theta_vel", "side"),
    [
        (20.0, 0.0, 1.0),
        (-20.0, 0.0, -1.0),
        (20.0, 100.0, -1.0),  # it was to the left, but the robot has turned 24 degrees past it
        (30.0, 100.0, 1.0),
        (-20.0, -100.0, 1.0),
    ],
)
def test_robot_turns_to_where_something_was_in_view_last(bearing: float, theta_vel: float, side: float) -> None:
    search = Search()
    search.leaves(-bearing, 0.0)
    search.leaves(bearing, 0.0)
    search.leaves(None, theta_vel)
    assert search.side == side
    for on in (50.0, 0.0):
        search.leaves(None, on * side)
        assert search.side == side


def test_bearing_is_that_of_the_nearest_thing_that_is_noticed() -> None:
    floor_map = torch.zeros(FloorObserver.shape, dtype=torch.uint8)
    floor_map[0, 2, 15] = NOTICED - 1
    floor_map[1:] = 200
    assert nearest_bearing(floor_map) is None
    places = map_places()
    for row, column in ((20, 25), (10, 11), (4, 18)):  # from far to near
        floor_map[0, row, column] = NOTICED
        forward, left = places[:, row, column].tolist()
        assert nearest_bearing(floor_map) == pytest.approx(math.degrees(math.atan2(left, forward)), abs=1e-3)


@pytest.mark.parametrize("bearing", [None, 5.0])
def test_robot_that_is_turned_back_again_and_again_drives_away(bearing: float | None) -> None:
    search = Search()
    avoided, free = 700.0, 0.0  # deg/s
    steps = [search.leaves(bearing, avoided if step in (0, 2, 4) else free) for step in range(5 + AWAY)]
    assert steps == [False] * 4 + [True] * AWAY + [False]


def test_a_wall_now_and_then_does_not_trap_a_robot() -> None:
    search = Search()
    assert not any(search.leaves(5.0, 700.0 if step % 8 == 0 else 0.0) for step in range(100))
