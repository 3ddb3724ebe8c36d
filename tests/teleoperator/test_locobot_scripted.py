"""The scripted teleoperator, as LeRobot makes and uses it."""

import pytest
from lerobot.teleoperators.utils import make_teleoperator_from_config

import relmm.plugin  # noqa: F401
from relmm.errors import ConfigError, RobotError
from relmm.features import Skill
from relmm.sim.config_locobot_sim import LocobotSimConfig
from relmm.sim.locobot_sim import LocobotSim
from relmm.teleoperator.config_locobot_scripted import LocobotScriptedConfig


def test_teleoperator_picks_something_up():
    teleoperator = make_teleoperator_from_config(LocobotScriptedConfig())
    robot = LocobotSim(LocobotSimConfig(seed=5))
    with robot, teleoperator:
        assert set(teleoperator.action_features) == set(robot.action_features)
        skills = []
        for _ in range(60):
            action = robot.send_action(teleoperator.get_action())
            skills.append(action["skill.pos"])
            if robot.get_observation()["holding.pos"]:
                break
        assert robot.body.truth.held()
        assert skills[-1] == Skill.GRASP


def test_teleoperator_without_a_robot_says_what_it_needs():
    teleoperator = make_teleoperator_from_config(LocobotScriptedConfig())
    with pytest.raises(RobotError, match="not connected"):
        teleoperator.get_action()
    teleoperator.connect()
    with pytest.raises(RobotError, match="exactly one connected LoCoBot"):
        teleoperator.get_action()


def test_teleoperator_of_an_unknown_camera_is_refused():
    with pytest.raises(ConfigError, match="paper, d435"):
        LocobotScriptedConfig(camera="webcam")
