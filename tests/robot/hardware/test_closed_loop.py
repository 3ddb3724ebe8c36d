"""The whole stack, from LeRobot's interface to the bytes, on a LoCoBot that the simulator moves."""

from __future__ import annotations

import re

import pytest

pytest.importorskip("serial", reason="pyserial is not installed (the extra `hardware`)")
pytest.importorskip("dynamixel_sdk", reason="dynamixel-sdk is not installed (the extra `hardware`)")
pytestmark = pytest.mark.slow  # real protocols in real time, which a busy machine upsets

from relmm.features import MAX_THETA_VEL, MAX_X_VEL, action_dict


@pytest.fixture
def robot(emulate, live_in_emulator):
    return live_in_emulator(emulate())


def test_robot_drives_and_turns_as_told(robot):
    before = robot.get_observation()
    assert before["front"].shape == (100, 100, 3)
    assert before["front"].std() > 5
    robot.send_action(action_dict(x_vel=MAX_X_VEL))
    moved = robot.get_observation()
    assert moved["x.vel"] == pytest.approx(MAX_X_VEL, abs=0.15)
    assert abs(moved["theta.vel"]) < 12
    robot.send_action(action_dict(theta_vel=MAX_THETA_VEL))
    assert robot.get_observation()["theta.vel"] == pytest.approx(MAX_THETA_VEL, abs=30)


def test_scripted_policy_picks_things_up(emulate, tmp_path):
    """Through the bytes, by the robot's own judgement, which the simulator confirms elsewhere."""
    options = ["--policy.type=relmm_scripted", "--policy.camera=d435", "--dataset.repo_id=me/x"]
    limits = ["--dataset.num_episodes=2", "--max_steps=40", "--pseudo_reset_steps=2"]
    root = tmp_path / "x"
    done = emulate().run("relmm.commands.record", *options, *limits, f"--dataset.root={root}")
    assert done.returncode == 0, done.stderr
    assert "robot_type" in (root / "meta" / "info.json").read_text()
    episodes, success = re.search(r"episodes +(\d+) \((\d+) by success", done.stdout).groups()
    assert int(episodes) == 2
    assert int(success) >= 1


def test_training_learns_from_it_and_goes_on(emulate, tmp_path):
    folder = tmp_path / "run"
    options = ["--policy.camera=d435", "--policy.num_stationary=1", "--curriculum.type=none", "--env_eval_freq=0"]
    options += ["--policy.min_attempts_to_update=2", "--policy.batch_size=8", f"--output_dir={folder}", "--save_freq=2"]
    done = emulate().run("relmm.commands.train", *options, "--steps=4")
    assert done.returncode == 0, done.stderr
    done = emulate().run("relmm.commands.train", *options, "--steps=6", "--resume=true")
    assert done.returncode == 0, done.stderr
    assert (folder / "checkpoints" / "000006").is_dir()
