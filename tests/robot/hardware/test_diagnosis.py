"""relmm-doctor on a LoCoBot: healthy, and with each part broken."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("serial", reason="pyserial is not installed (the extra `hardware`)")
pytest.importorskip("dynamixel_sdk", reason="dynamixel-sdk is not installed (the extra `hardware`)")
pytestmark = pytest.mark.slow  # real protocols in real time, which a busy machine upsets

from dynamixel_emulator import BAUD_RATE, MODEL, TEMPERATURE, VOLTAGE, DynamixelEmulator
from kobuki_emulator import KobukiEmulator

from relmm.commands import doctor
from relmm.robot.hardware import kobuki as driver
from relmm.robot.hardware import ports


@pytest.fixture
def robot(tmp_path, realsense, monkeypatch):
    """Base and chain behind names as udev gives them, and the outcome of a look at them."""
    by_id = tmp_path / "by-id"
    by_id.mkdir()
    monkeypatch.setattr(ports, "BY_ID", by_id)
    monkeypatch.setattr(doctor, "CHECKS", {})
    monkeypatch.chdir(tmp_path)
    realsense.source = lambda: (np.zeros((480, 640, 3), np.uint8), np.zeros((480, 640), np.uint16))
    base_name = "usb-Yujin_Robot_iClebo_Kobuki_kobuki_AI02MRHX-if00-port0"
    arm_name = "usb-FTDI_USB__-__Serial_Converter_FT4THVLP-if00-port0"
    with KobukiEmulator(by_id / base_name) as base, DynamixelEmulator(by_id / arm_name) as chain:
        yield base, chain


def look(capsys, monkeypatch, *options: str) -> tuple[int, str]:
    monkeypatch.setattr("sys.argv", ["relmm-doctor", "--robot.type=locobot", *options])
    with pytest.raises(SystemExit) as end:
        doctor.main()
    return end.value.code, capsys.readouterr().out


def test_healthy_robot_is_found_by_itself(robot, capsys, monkeypatch):
    code, said = look(capsys, monkeypatch)
    assert code == 0, said
    assert "firmware 1.2.0, battery 16.0 V" in said
    assert said.count("  ok  ") == 1 + 1 + 1 + 9 + 1
    assert "motor 10, 2xl430-w250, 12.1 V, 33 degrees C" in said
    assert "RealSense 821212062500 on USB 3.2" in said
    assert robot[1].log == [], "nothing is written to a motor"
    assert {command[1:] for command in robot[0].commands} <= {(0, 0)}


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        (lambda base, chain: setattr(base, "battery", 13.5), "battery is at 13.5 V, below 14.0 V"),
        (lambda base, chain: setattr(base, "wheel_drop", 3), r"a wheel hangs \(3\)"),
        (lambda base, chain: setattr(base, "powered", False), "The base does not answer"),
        (lambda base, chain: chain.motors.pop(5), "Motor 5 does not answer at 1,000,000 nor at 57,600 baud"),
        (lambda base, chain: chain.motors[6].set(BAUD_RATE, 1), "Motor 6 answers at 57,600 baud only"),
        (lambda base, chain: chain.motors[7].set(MODEL, 1020), "Motor 7 is of model 1020"),
        (lambda base, chain: chain.motors[4].fail(4), r"Motor 4 has switched itself off \(overheating\)"),
        (lambda base, chain: chain.motors[1].set(VOLTAGE, 82), "Motor 1 gets 8.2 V"),
        (lambda base, chain: chain.motors[2].set(TEMPERATURE, 77), "Motor 2 is at 77 degrees C"),
        (lambda base, chain: base.unplug(), "No base was found in"),
        (lambda base, chain: chain.cable.unplug(), "No arm was found in .*there is usb-Yujin"),
    ],
)
def test_each_fault_is_one_sentence(robot, capsys, monkeypatch, fault, words):
    fault(*robot)
    if not robot[0].powered:
        monkeypatch.setattr(driver, "_START_S", 1.0)  # to wait for it in vain
    code, said = look(capsys, monkeypatch)
    assert code == 1
    lines = [line for line in said.splitlines() if "FAIL" in line]
    assert any(__import__("re").search(words, line) for line in lines), said


def test_missing_camera_is_one_sentence(robot, realsense, capsys, monkeypatch):
    monkeypatch.setattr(realsense, "plugged", 0)
    code, said = look(capsys, monkeypatch)
    assert code == 1
    assert [line.split(maxsplit=2) for line in said.splitlines() if "FAIL" in line] == [
        ["FAIL", "camera", "0 RealSense cameras are plugged in. Plug one into USB 3."]
    ]
