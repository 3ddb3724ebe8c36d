"""The real body on emulators: what it refuses, what stops it, and how it waits to be charged."""

from __future__ import annotations

import threading
import time

import numpy as np
import pytest

pytest.importorskip("serial", reason="pyserial is not installed (the extra `hardware`)")
pytest.importorskip("dynamixel_sdk", reason="dynamixel-sdk is not installed (the extra `hardware`)")
pytestmark = pytest.mark.slow  # real protocols in real time, which a busy machine upsets

from dynamixel_emulator import DynamixelEmulator
from dynamixel_sdk import port_handler
from kobuki_emulator import KobukiEmulator

from relmm.errors import RobotError
from relmm.robot.hardware import body as body_module
from relmm.robot.hardware import d435
from relmm.robot.hardware.config_locobot import LocobotConfig
from relmm.robot.hardware.locobot import Locobot
from relmm.robot.hardware.widowx import SLEEP_POSE

LIMIT_S = 10.0  # of waiting; catches hangs


@pytest.fixture
def parts(tmp_path, realsense, monkeypatch):
    realsense.source = lambda: (np.full((480, 640, 3), 100, np.uint8), np.full((480, 640), 600, np.uint16))
    monkeypatch.setattr(port_handler, "LATENCY_TIMER", 100)
    with KobukiEmulator(tmp_path / "base") as base, DynamixelEmulator(tmp_path / "arm") as chain:
        yield base, chain, realsense


@pytest.fixture
def make(parts, tmp_path):
    made = []

    def connect(**settings) -> Locobot:
        ports = {"base_port": str(tmp_path / "base"), "arm_port": str(tmp_path / "arm")}
        robot = Locobot(LocobotConfig(**ports, calibration_dir=tmp_path, **settings))
        made.append(robot)
        robot.connect()
        return robot

    yield connect
    for robot in made:
        robot.disconnect()


def wait_for(condition, what: str) -> None:
    until = time.monotonic() + LIMIT_S
    while not condition():
        assert time.monotonic() < until, f"waited in vain for {what}"
        time.sleep(0.005)


def drive(base, robot) -> None:
    robot.body.drive(0.3, 0.0)
    wait_for(lambda: base.command[0] > 0, "the base to move")


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        (lambda base, chain, eye: setattr(chain, "powered", False), "The arm does not answer"),
        (lambda base, chain, eye: chain.cable.unplug(), "The arm does not answer"),
        (lambda base, chain, eye: chain.motors[2].fail(32), r"Motor 2 \(shoulder\) has switched itself off: overload"),
        (lambda base, chain, eye: setattr(eye, "source", _no_picture), "The camera sends no pictures"),
        (lambda base, chain, eye: setattr(base, "battery", 12.0), "nearly empty: charge"),
        (lambda base, chain, eye: base.unplug(), "The base on .* has been silent"),
    ],
)
@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_lost_part_stops_the_base_and_is_one_sentence(parts, make, monkeypatch, fault, words):
    monkeypatch.setattr(d435, "_LOST_S", 0.5)
    monkeypatch.setattr(body_module, "_RECONNECT_S", 1.0)
    robot = make()
    drive(parts[0], robot)
    fault(*parts)
    with pytest.raises(RobotError, match=words):
        robot.body.wait(LIMIT_S)
    if parts[0].cable.plugged:
        wait_for(lambda: parts[0].command == (0, 0), "a stop")


def _no_picture() -> None:
    raise RuntimeError("no device")


def test_base_that_comes_back_is_waited_for(parts, make):
    robot = make()
    parts[0].unplug()
    threading.Timer(1.5, parts[0].plug).start()
    robot.body.wait(2.5)
    drive(parts[0], robot)


def test_low_battery_refuses_to_start(parts, make):
    parts[0].battery = 13.8
    with pytest.raises(RobotError, match=r"The battery is at 13.8 V, and 14.0 V are needed to begin: charge it first"):
        make()
    assert not any(motor.torque for motor in parts[1].motors.values()), "nothing has moved"
    assert parts[2].started == 0, "nothing is left open"


def test_robot_lies_down_until_it_is_charged(parts, make, monkeypatch):
    base, chain, _ = parts
    monkeypatch.setattr(body_module, "_CHARGE_POLL_S", 0.05)
    robot = make()
    assert not robot.needs_charging
    base.battery = 13.5
    wait_for(lambda: robot.needs_charging, "a low battery")
    charged = threading.Thread(target=robot.await_charge, args=(lambda: False,))
    charged.start()
    wait_for(lambda: not any(motor.torque for motor in chain.motors.values()), "the arm to lie down")
    base.battery, base.charger = 16.4, 22
    time.sleep(1.0)
    assert charged.is_alive(), "the charger is still plugged in"
    base.charger = 0
    charged.join(20)
    assert not charged.is_alive()
    assert all(motor.torque for motor in chain.motors.values())


def test_disconnecting_stops_rests_and_lets_go(parts, make):
    base, chain, eye = parts
    robot = make()
    drive(base, robot)
    robot.disconnect()
    assert base.command == (0, 0)
    assert np.abs([chain.motors[i].angle for i in (1, 2, 4, 5, 6)] - SLEEP_POSE).max() < 0.05
    assert not any(motor.torque for motor in chain.motors.values())
    assert eye.started == 0


def test_dry_run_says_what_it_would_do(parts, make, capsys):
    base, chain, _ = parts
    robot = make(dry_run=True)
    robot.send_action({"x.vel": 0.3})
    said = capsys.readouterr().out
    assert "would drive at 0.30 m/s, turn at 0 deg/s" in said
    assert "would move the arm to" in said
    assert {command[1:] for command in base.commands} == {(0, 0)}
    assert chain.log == []
