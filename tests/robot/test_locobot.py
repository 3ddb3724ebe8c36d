"""LeRobot's `Robot` contract, on the simulated body."""

from __future__ import annotations

import logging
from collections.abc import Iterator

import mujoco
import numpy as np
import pytest
import torch

from relmm.errors import RobotError
from relmm.features import (
    ACTION_NAMES,
    BASKET_XY,
    DRIVE_PULSE_S,
    GRASP_X,
    GRASP_Y,
    MAX_THETA_VEL,
    MAX_X_VEL,
    MOTION_NAMES,
    SCAN_NAMES,
    STATE_NAMES,
    Skill,
    action_dict,
    carried_out,
)
from relmm.robot.locobot import LocobotRobot
from relmm.robot.skills import REST_POSE
from relmm.sim.config_locobot_sim import LocobotSimConfig
from relmm.sim.locobot_sim import LocobotSim
from relmm.sim.rooms import set_objects

STILL = action_dict()


@pytest.fixture(scope="module")
def shared_robot() -> Iterator[LocobotSim]:
    robot = LocobotSim(LocobotSimConfig(num_objects=3, depth=True))
    robot.connect()
    yield robot
    robot.disconnect()


@pytest.fixture
def robot(shared_robot: LocobotSim) -> LocobotSim:
    shared_robot.reset(0)
    return shared_robot


@pytest.fixture
def holding(robot: LocobotSim) -> LocobotSim:
    """A robot with an object in its gripper."""
    body = robot.body
    x, y, heading = body.truth.robot()
    poses = np.column_stack([body.truth.objects()[:, :2], np.zeros(3)])
    poses[0, :2] = x + 0.4 * np.cos(heading), y + 0.4 * np.sin(heading)
    set_objects(body.model, body.data, poses)
    mujoco.mj_forward(body.model, body.data)
    body.wait(0.3)
    assert robot.send_action(action_dict(Skill.GRASP, x=0.4)) == action_dict(Skill.GRASP, x=0.4)
    assert robot.skills.holding
    return robot


# --- Features and observations -------------------------------------------------------------------------------
@pytest.mark.parametrize("depth", [False, True])
def test_features_are_known_before_connecting(depth: bool) -> None:
    features = LocobotSim(LocobotSimConfig(depth=depth)).observation_features
    assert features["front"] == (100, 100, 3)
    assert ("front_depth" in features) == depth
    assert [name for name, kind in features.items() if kind is float] == list(STATE_NAMES)


def test_an_observation_has_what_the_features_promise(robot: LocobotSim) -> None:
    observation = robot.get_observation()
    assert list(observation) == list(robot.observation_features)
    for name, kind in robot.observation_features.items():
        if kind is float:
            assert type(observation[name]) is float
        else:
            assert observation[name].shape == kind


def test_the_state_is_in_the_units_of_the_vocabulary(robot: LocobotSim) -> None:
    robot.send_action({"x.vel": 0.3, "theta.vel": 60.0})
    state = robot.get_observation()
    assert state["x.vel"] == pytest.approx(0.3, abs=0.03)  # m/s
    assert state["theta.vel"] == pytest.approx(60.0, abs=6.0)  # deg/s
    assert state["elbow.pos"] == pytest.approx(np.degrees(REST_POSE[2]), abs=3)  # degrees
    assert state["gripper.pos"] == pytest.approx(0.044, abs=0.002)  # m
    assert state["holding.pos"] == state["bumper.pos"] == 0.0


def test_motion_and_scan_stand_under_their_names(robot: LocobotSim) -> None:
    robot.send_action({"x.vel": 0.4, "theta.vel": 100.0})
    state, skills = robot.get_observation(), robot.skills
    assert skills.motion()[1] > 0.01
    assert len(set(skills.scan())) > 5
    assert [state[name] * DRIVE_PULSE_S for name in MOTION_NAMES] == pytest.approx(skills.motion().tolist())
    assert [state[name] for name in SCAN_NAMES] == skills.scan().tolist()


def test_action_features_are_the_five_actions(robot: LocobotSim) -> None:
    assert robot.action_features == dict.fromkeys(ACTION_NAMES, float)


# --- Actions -------------------------------------------------------------------------------------------------
def test_floats_and_tensors_do_the_same(robot: LocobotSim) -> None:
    action = action_dict(x_vel=0.25, theta_vel=-50.0)
    sent = robot.send_action(action)
    state = robot.body.data.qpos.copy()
    robot.reset(0)
    assert robot.send_action({name: torch.tensor(value, dtype=torch.float64) for name, value in action.items()}) == sent
    np.testing.assert_array_equal(robot.body.data.qpos, state)
    assert all(type(value) is float for value in sent.values())


def test_tensors_of_one_value_are_accepted(robot: LocobotSim) -> None:
    sent = robot.send_action({name: torch.tensor([0.25 if name == "x.vel" else 0.0]) for name in ACTION_NAMES})
    assert sent == action_dict(x_vel=0.25)


def test_what_is_missing_counts_as_zero(robot: LocobotSim) -> None:
    assert robot.send_action({"theta.vel": 30.0}) == action_dict(theta_vel=30.0)


@pytest.mark.parametrize("action", [{}, {"waist.pos": 10.0, "elbow.pos": 20.0}])
def test_an_action_without_any_of_the_names_stops_the_robot(robot: LocobotSim, action: dict[str, float]) -> None:
    robot.body.drive(0.4, 0.0)
    robot.body.wait(0.3)
    assert robot.send_action(action) == STILL
    robot.body.wait(0.3)
    before = robot.body.truth.robot()
    robot.body.wait(0.5)
    assert robot.body.truth.robot() == pytest.approx(before, abs=0.002)


@pytest.mark.parametrize(
    ("action", "sent"),
    [
        ({"x.vel": 9.0}, action_dict(x_vel=MAX_X_VEL)),
        ({"x.vel": -1.0}, STILL),
        ({"theta.vel": 999.0}, action_dict(theta_vel=MAX_THETA_VEL)),
        ({"theta.vel": -999.0}, action_dict(theta_vel=-MAX_THETA_VEL)),
        ({"skill.pos": 1.0, "skill_x.pos": 0.0, "skill_y.pos": 5.0}, action_dict(Skill.GRASP, x=GRASP_X[0], y=0.08)),
        ({"skill.pos": 1.0, "skill_x.pos": 7.0}, action_dict(Skill.GRASP, x=GRASP_X[1])),
        ({"skill.pos": 0.2, "x.vel": 0.1}, action_dict(x_vel=0.1)),
    ],
)
def test_actions_are_clipped_and_what_was_done_is_returned(
    robot: LocobotSim, action: dict[str, float], sent: dict[str, float]
) -> None:
    assert robot.send_action(action) == sent


@pytest.mark.parametrize("name", ACTION_NAMES)
@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
def test_what_is_not_finite_is_refused_before_anything_moves(robot: LocobotSim, name: str, value: float) -> None:
    state = robot.body.data.qpos.copy()
    with pytest.raises(RobotError, match="finite"):
        robot.send_action({"x.vel": 0.4, name: value})
    np.testing.assert_array_equal(robot.body.data.qpos, state)


@pytest.mark.parametrize("skill", [3.0, 2.6, 1e9])
def test_skills_out_of_range_become_the_nearest_as_a_regression_means_them(holding: LocobotSim, skill: float) -> None:
    """A policy that imitates answers with any number; nothing may end its episode."""
    assert holding.send_action({"skill.pos": skill, "skill_x.pos": 0.4})["skill.pos"] == Skill.PLACE
    assert holding.send_action({"skill.pos": -0.7})["skill.pos"] == Skill.NAVIGATE


# --- Holding -------------------------------------------------------------------------------------------------
def test_a_grasp_with_a_full_gripper_stands_still(holding: LocobotSim) -> None:
    before = holding.body.truth.robot()
    assert holding.send_action(action_dict(Skill.GRASP, x_vel=0.4, x=0.4)) == STILL
    assert holding.body.truth.robot() == pytest.approx(before, abs=0.01)
    assert holding.body.truth.held()


def test_a_placement_with_an_empty_gripper_stands_still(robot: LocobotSim) -> None:
    before = robot.body.truth.robot()
    assert robot.send_action(action_dict(Skill.PLACE, x_vel=0.4, x=0.4)) == STILL
    assert robot.body.truth.robot() == pytest.approx(before, abs=0.01)


@pytest.mark.parametrize(
    "action",
    [action_dict(x_vel=9.0, theta_vel=-900.0), action_dict(Skill.PLACE, x_vel=0.4, x=0.4)],
    ids=["drive", "place"],
)
def test_what_is_done_is_what_a_recorded_command_is_taken_for(
    robot: LocobotSim, action: dict[str, float], caplog: pytest.LogCaptureFixture
) -> None:
    """Where LeRobot's recorder has kept the command only; and it is nothing to warn of at every step."""
    taken_for = carried_out(np.array([list(action.values())]), np.array([False]))[0]
    assert list(robot.send_action(action).values()) == pytest.approx(taken_for)
    assert not [record for record in caplog.records if record.levelno >= logging.WARNING]


def test_holding_is_observed(holding: LocobotSim) -> None:
    assert holding.get_observation()["holding.pos"] == 1.0
    holding.send_action(action_dict(Skill.PLACE, x=0.4))
    assert holding.get_observation()["holding.pos"] == 0.0


def test_a_place_near_the_basket_is_the_basket(holding: LocobotSim) -> None:
    sent = holding.send_action(action_dict(Skill.PLACE, x=BASKET_XY[0] + 0.02, y=BASKET_XY[1] - 0.02))
    assert sent == action_dict(Skill.PLACE, x=BASKET_XY[0], y=BASKET_XY[1])
    assert holding.body.truth.in_basket().tolist() == [0]


def test_a_place_out_of_reach_becomes_the_nearest_in_reach(holding: LocobotSim) -> None:
    sent = holding.send_action(action_dict(Skill.PLACE, x=0.9, y=-0.5))
    assert sent == action_dict(Skill.PLACE, x=GRASP_X[1], y=GRASP_Y[0])


def test_a_reset_empties_the_gripper(holding: LocobotSim) -> None:
    holding.reset(0)
    assert holding.get_observation()["holding.pos"] == 0.0


# --- Connection ----------------------------------------------------------------------------------------------
def test_connecting_twice_is_refused(robot: LocobotSim) -> None:
    with pytest.raises(RobotError, match=r"connected already: call disconnect\(\) first"):
        robot.connect()


@pytest.mark.parametrize("call", ["get_observation", "send_action"])
def test_without_a_connection_nothing_works(call: str) -> None:
    robot = LocobotSim(LocobotSimConfig())
    with pytest.raises(RobotError, match=r"not connected: call connect\(\) first"):
        getattr(robot, call)(*([STILL] if call == "send_action" else []))


def test_disconnecting_stops_the_wheels_and_may_be_repeated() -> None:
    robot = LocobotSim(LocobotSimConfig(num_objects=1))
    robot.disconnect()
    robot.connect()
    assert robot.is_connected
    assert robot in LocobotRobot.connected()
    body = robot.body
    body.drive(0.4, 0.0)
    body.wait(0.3)
    robot.disconnect()
    robot.disconnect()
    assert not robot.is_connected
    assert robot not in LocobotRobot.connected()
    body.wait(0.3)
    before = body.truth.robot()
    body.wait(0.5)
    assert body.truth.robot() == pytest.approx(before, abs=0.002)


def test_a_robot_can_be_connected_again() -> None:
    robot = LocobotSim(LocobotSimConfig(num_objects=1))
    for _ in range(2):
        robot.connect()
        robot.send_action(action_dict(x_vel=0.2))
        assert robot.get_observation()["x.vel"] == pytest.approx(0.2, abs=0.02)
        robot.disconnect()
        assert not robot.is_connected


def test_it_is_a_calibrated_robot(robot: LocobotSim) -> None:
    assert robot.is_calibrated
    robot.calibrate()
    robot.configure()
