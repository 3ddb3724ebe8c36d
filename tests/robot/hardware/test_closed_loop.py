"""The whole stack, from LeRobot's interface to the bytes, on a LoCoBot that the simulator moves."""

from __future__ import annotations

import pytest

pytest.importorskip("serial", reason="pyserial is not installed (the extra `hardware`)")
pytest.importorskip("dynamixel_sdk", reason="dynamixel-sdk is not installed (the extra `hardware`)")

from relmm.features import MAX_THETA_VEL, MAX_X_VEL, action_dict
from relmm.robot.hardware.config_locobot import LocobotConfig
from relmm.robot.hardware.locobot import Locobot
from relmm.sim.config_locobot_sim import LocobotSimConfig
from relmm.sim.locobot_sim import LocobotSim


@pytest.fixture
def robot(emulate, realsense, monkeypatch, request):
    emulated = emulate(**getattr(request, "param", {}))
    for name in ("RELMM_FAKE_REALSENSE", "RELMM_FAKE_REALSENSE_FPS"):
        monkeypatch.setenv(name, emulated.environment[name])
    monkeypatch.setattr(realsense, "fps", 6.0)
    robot = Locobot(
        LocobotConfig(
            base_port=str(emulated.folder / "kobuki"),
            arm_port=str(emulated.folder / "dxl"),
            calibration_dir=emulated.folder / "calibration",
        )
    )
    robot.connect()
    yield robot
    robot.disconnect()


@pytest.mark.parametrize("depth", [False, True])
def test_features_are_those_of_the_simulated_robot(tmp_path, depth):
    real = Locobot(LocobotConfig(depth=depth, calibration_dir=tmp_path))
    simulated = LocobotSim(LocobotSimConfig(depth=depth, camera="d435", calibration_dir=tmp_path))
    assert list(real.observation_features.items()) == list(simulated.observation_features.items())
    assert list(real.action_features.items()) == list(simulated.action_features.items())


def test_robot_drives_and_turns_as_told(robot):
    before = robot.get_observation()
    assert before["front"].shape == (100, 100, 3)
    assert before["front"].std() > 5
    robot.send_action(action_dict(x_vel=MAX_X_VEL))
    moved = robot.get_observation()
    assert moved["x.vel"] == pytest.approx(MAX_X_VEL, abs=0.12)
    assert abs(moved["theta.vel"]) < 12
    robot.send_action(action_dict(theta_vel=MAX_THETA_VEL))
    assert robot.get_observation()["theta.vel"] == pytest.approx(MAX_THETA_VEL, abs=30)


@pytest.mark.slow
@pytest.mark.parametrize("robot", [{"num_objects": 60}], indirect=True)
def test_robot_picks_something_up(robot):
    """By the scripted policy's own eyes, which know nothing of what is behind the bytes."""
    from relmm.commands.policies import make_actor
    from relmm.policies.scripted.configuration_scripted import RelmmScriptedConfig

    actor = make_actor(RelmmScriptedConfig(device="cpu"))
    for _ in range(40):
        observation = robot.get_observation()
        robot.send_action(actor.act(observation))
        if robot.get_observation()["holding.pos"]:
            return
    pytest.fail("nothing was picked up")
