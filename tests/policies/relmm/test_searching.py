"""When a robot that sees nothing goes elsewhere."""

import math

import pytest

from relmm.features import DRIVE_PULSE_S, MAX_THETA_VEL
from relmm.policies.relmm.searching import Search

AWAY = 12


@pytest.mark.parametrize("theta_vel", [MAX_THETA_VEL, -60.0, 100.0])
def test_robot_looks_all_round_before_it_goes_straight_on(theta_vel: float) -> None:
    search, looks = Search(), math.ceil(360 / (abs(theta_vel) * DRIVE_PULSE_S))
    for _ in range(2):
        steps = [search.leaves(False, theta_vel) for _ in range(looks)]
        steps += [search.leaves(False, 0.0) for _ in range(AWAY)]
        assert steps == [False] * (looks - 1) + [True] * AWAY + [False], "and looks again"


def test_what_comes_into_view_begins_the_look_anew() -> None:
    search = Search()
    looks = [search.leaves(False, 90.0) for _ in range(16)]
    assert not any(looks)
    assert not search.leaves(True, 90.0)
    assert [search.leaves(False, 90.0) for _ in range(16)] == looks
    assert search.leaves(False, 90.0)
    assert search.leaves(True, 0.0), "what is far is often out of sight again with the next turn"


def test_steps_on_the_way_count_since_the_last_wall() -> None:
    search = Search()
    assert [search.leaves(False, 90.0) for _ in range(17)][-1]
    assert all(search.leaves(False, 0.0) for _ in range(5))
    assert search.leaves(False, 450.0)
    assert [search.leaves(False, 0.0) for _ in range(AWAY)] == [True] * (AWAY - 1) + [False]


def test_robot_that_does_not_turn_has_not_looked_round() -> None:
    search = Search()
    assert not any(search.leaves(False, 0.0) for _ in range(100))
