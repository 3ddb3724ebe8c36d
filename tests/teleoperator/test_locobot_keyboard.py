"""A person at a keyboard: keys typed into a terminal, as LeRobot's listener reads them."""

from __future__ import annotations

import os
import pty
import time

import pytest
from lerobot.teleoperators.utils import TeleopEvents, make_teleoperator_from_config

from relmm.errors import RobotError
from relmm.features import BASKET_XY, MAX_THETA_VEL, MAX_X_VEL, Skill, action_dict, in_grasp_area
from relmm.sim.config_locobot_sim import LocobotSimConfig
from relmm.sim.locobot_sim import LocobotSim
from relmm.teleoperator.config_locobot_keyboard import LocobotKeyboardConfig
from relmm.teleoperator.locobot_keyboard import keypad_place


@pytest.fixture
def keyboard(monkeypatch):
    """The teleoperator, and a function that types."""
    master, slave = pty.openpty()
    with os.fdopen(slave) as terminal:
        monkeypatch.setattr("sys.stdin", terminal)
        teleoperator = make_teleoperator_from_config(LocobotKeyboardConfig())
        teleoperator.connect()

        def type_key(key: str) -> None:
            os.write(master, key.encode())
            until = time.monotonic() + 20
            while not teleoperator._pressed.is_set():
                assert time.monotonic() < until, f"{key} was not heard"
                time.sleep(0.005)
            teleoperator.wait(0)

        yield teleoperator, type_key
        teleoperator.disconnect()
    os.close(master)


@pytest.mark.parametrize(
    ("key", "action"),
    [
        ("w", action_dict(x_vel=MAX_X_VEL)),
        ("a", action_dict(theta_vel=MAX_THETA_VEL)),
        ("d", action_dict(theta_vel=-MAX_THETA_VEL)),
        ("D", action_dict(theta_vel=-MAX_THETA_VEL / 4)),
    ],
)
def test_a_key_is_a_navigation_step(keyboard, key, action):
    teleoperator, type_key = keyboard
    type_key(key)
    assert teleoperator.get_action() == action
    assert teleoperator.get_action() == action_dict(), "it stands still until the next key"


def test_the_last_of_several_keys_counts(keyboard):
    teleoperator, type_key = keyboard
    for key in "wwa":
        type_key(key)
    assert teleoperator.next_action() == action_dict(theta_vel=MAX_THETA_VEL)
    assert teleoperator.next_action() is None


def test_take_over_is_an_intervention_until_it_is_given_back(keyboard):
    teleoperator, type_key = keyboard
    for taken in (True, False):
        type_key("t")
        assert teleoperator.get_teleop_events() == {
            **dict.fromkeys(TeleopEvents, False),
            TeleopEvents.IS_INTERVENTION: taken,
        }


def test_digits_are_places_as_on_a_keypad():
    places = {digit: keypad_place(digit) for digit in range(1, 10)}
    assert all(in_grasp_area(*place) for place in places.values())
    assert places[7][0] == places[8][0] > places[4][0] > places[1][0], "7, 8 and 9 are far"
    assert places[7][1] == places[4][1] > places[8][1] > places[9][1], "7, 4 and 1 are on the left"
    assert places[5][1] == pytest.approx(0.0)


def test_person_picks_something_up_and_drops_it_into_the_basket(keyboard):
    teleoperator, type_key = keyboard
    robot = LocobotSim(LocobotSimConfig(room="no_obstacles", num_objects=1, seed=0))
    with robot:
        robot.body.put_object(0, keypad_place(4))
        robot.skills.forget_picture()
        type_key("4")
        action = robot.send_action(teleoperator.get_action())
        assert action["skill.pos"] == Skill.GRASP
        assert robot.skills.holding
        type_key("0")
        action = robot.send_action(teleoperator.get_action())
        assert (action["skill.pos"], action["skill_x.pos"], action["skill_y.pos"]) == (Skill.PLACE, *BASKET_XY)
        assert not robot.skills.holding


def test_reaching_without_a_robot_says_what_it_needs(keyboard):
    teleoperator, type_key = keyboard
    type_key("5")
    with pytest.raises(RobotError, match="exactly one connected LoCoBot in this process, but there are 0"):
        teleoperator.get_action()


def test_no_terminal_is_one_sentence(monkeypatch):
    with open(os.devnull) as nothing:
        monkeypatch.setattr("sys.stdin", nothing)
        with pytest.raises(RobotError, match="start the command in a terminal"):
            make_teleoperator_from_config(LocobotKeyboardConfig()).connect()
