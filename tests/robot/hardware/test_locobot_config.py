"""What a LoCoBot is to LeRobot, with nothing plugged in and nothing installed beyond relmm."""

from __future__ import annotations

import subprocess
import sys

import pytest

from relmm.errors import ConfigError, RobotError
from relmm.robot.hardware import ports
from relmm.robot.hardware.config_locobot import LocobotConfig
from relmm.robot.hardware.locobot import Locobot
from relmm.sim.config_locobot_sim import LocobotSimConfig
from relmm.sim.locobot_sim import LocobotSim


@pytest.mark.parametrize("depth", [False, True])
def test_features_are_those_of_the_simulated_robot(tmp_path, depth):
    real = Locobot(LocobotConfig(depth=depth, calibration_dir=tmp_path))
    simulated = LocobotSim(LocobotSimConfig(depth=depth, camera="d435", calibration_dir=tmp_path))
    assert list(real.observation_features.items()) == list(simulated.observation_features.items())
    assert list(real.action_features.items()) == list(simulated.action_features.items())


def test_other_cameras_are_refused():
    with pytest.raises(ConfigError, match=r"robot.camera is 'paper', but the camera of a LoCoBot is 'd435'"):
        LocobotConfig(camera="paper")


def test_nothing_plugged_in_is_one_sentence(tmp_path, monkeypatch):
    monkeypatch.setattr(ports, "BY_ID", tmp_path)
    robot = Locobot(LocobotConfig(calibration_dir=tmp_path))
    with pytest.raises(RobotError, match=r"No base was found in .* \(there is nothing\): plug it in, or say"):
        robot.connect()
    assert not robot.is_connected


def test_guard_starts_without_heavy_imports():
    heavy = (
        "import relmm.robot.hardware.guard, sys; print([m for m in ('numpy', 'torch', 'lerobot') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", heavy], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
