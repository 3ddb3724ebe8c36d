"""The driver of the base on a pseudo-terminal, and how soon the base stands still after every fault."""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import time
from itertools import pairwise

import pytest

pytest.importorskip("serial", reason="pyserial is not installed (the extra `hardware`)")

from kobuki_emulator import KobukiEmulator, noisy

from relmm.errors import RobotError
from relmm.robot.hardware import kobuki as driver
from relmm.robot.hardware.kobuki import Kobuki
from relmm.robot.hardware.kobuki_protocol import Sound

LIMIT_S = 10.0  # of waiting; catches hangs, and says nothing about speed


def wait_for(condition, what: str) -> None:
    until = time.monotonic() + LIMIT_S
    while not condition():
        assert time.monotonic() < until, f"waited in vain for {what}"
        time.sleep(0.005)


@pytest.fixture
def base(tmp_path):
    with KobukiEmulator(tmp_path / "kobuki") as emulator:
        yield emulator


@pytest.fixture
def kobuki(base, tmp_path):
    driver = Kobuki(str(tmp_path / "kobuki"))
    driver.wait_until_there()
    yield driver
    driver.close()


def drive_until_it_moves(base, kobuki) -> None:
    def moves() -> bool:
        if stands(base):
            kobuki.drive(0.3, 0.0)
        return base.command[0] > 100

    wait_for(moves, "the base to move")


def stands(base) -> bool:
    return base.command == (0, 0)


# --- Driving -------------------------------------------------------------------------------------------------
def test_base_drives_and_tells_how_far(base, kobuki):
    for _ in range(3):
        kobuki.drive(0.2, 0.0)
        time.sleep(0.3)
    kobuki.drive(0.0, 0.0)
    wait_for(lambda: stands(base) and base.plant.speed == 0.0, "a stop")
    driven = (base.plant.left + base.plant.right) / 2
    wait_for(lambda: kobuki.state().travelled == pytest.approx(driven, abs=2e-3), "odometry")
    assert driven > 0.05


def test_base_turns_left_for_positive_rates(base, kobuki):
    kobuki.drive(0.0, 60.0)
    wait_for(lambda: kobuki.state().heading > 3.0, "a turn")
    assert base.plant.heading > 0


def test_speed_grows_with_limited_acceleration_and_is_clamped(base, kobuki):
    kobuki.drive(99.0, 0.0)
    wait_for(lambda: base.command[0] == 440, "full speed")
    speeds = [speed for _, speed, _ in base.commands]
    assert max(b - a for a, b in pairwise(speeds)) <= 45


def test_state_tells_battery_and_firmware(base, kobuki):
    base.battery = 14.2
    wait_for(lambda: kobuki.state().battery == pytest.approx(14.2, abs=0.05), "the battery")
    wait_for(lambda: kobuki.state().firmware == (1, 2, 0), "the firmware's version")


def test_tunes_and_lights_reach_the_base(base, kobuki):
    kobuki.play(Sound.ON)
    wait_for(lambda: base.sounds == [0], "a tune")
    assert base.output & 0xF0 == 0xF0, "the arm's power stays on"


def test_noise_on_the_line_does_no_harm(base, kobuki):
    base.noise = noisy(random.Random(0))
    before = kobuki.state().packets
    wait_for(lambda: kobuki.state().packets > before + 50, "packets")
    assert kobuki.state().travelled == 0.0
    assert base.bad_bytes == 0


def test_dry_run_sends_stops_only(base, tmp_path):
    kobuki = Kobuki(str(tmp_path / "kobuki"), dry=True)
    kobuki.wait_until_there()
    kobuki.drive(0.3, 0.0)
    time.sleep(0.3)
    kobuki.close()
    assert {command[1:] for command in base.commands} == {(0, 0)}


# --- Stopping ------------------------------------------------------------------------------------------------
def test_command_expires(base, kobuki):
    drive_until_it_moves(base, kobuki)
    wait_for(lambda: stands(base), "the command to expire")
    moved = [t for t, speed, _ in base.commands if speed]
    assert moved[-1] - moved[0] < driver.COMMAND_S + 0.1


@pytest.mark.parametrize(("switch", "bits"), [("bumper", 2), ("cliff", 4), ("wheel_drop", 1), ("over_current", 2)])
def test_what_the_base_meets_stops_it_at_once(base, kobuki, switch, bits):
    drive_until_it_moves(base, kobuki)
    setattr(base, switch, bits)
    wait_for(lambda: stands(base), "a stop")
    kobuki.drive(0.3, 0.0)
    time.sleep(0.2)
    assert stands(base), "forward motion is forbidden"
    kobuki.drive(-0.1, 0.0)
    if switch in ("bumper", "cliff"):
        wait_for(lambda: base.command[0] < 0, "the way back")
    else:
        time.sleep(0.2)
        assert stands(base)
    setattr(base, switch, 0)
    drive_until_it_moves(base, kobuki)


def test_bump_is_remembered_until_it_is_forgotten(base, kobuki):
    base.bumper = 4
    wait_for(lambda: kobuki.state().bumped == 4, "the bumper")
    base.bumper = 0
    wait_for(lambda: kobuki.state().bumper == 0, "its release")
    assert kobuki.state().bumped == 4
    kobuki.forget_bumps()
    assert kobuki.state().bumped == 0


def test_close_stops_the_base(base, kobuki):
    drive_until_it_moves(base, kobuki)
    kobuki.close()
    wait_for(lambda: stands(base), "a stop")


def test_no_base_is_one_sentence(tmp_path, monkeypatch):
    monkeypatch.setattr(driver, "_START_S", 0.5)
    kobuki = Kobuki(str(tmp_path / "nothing"))
    try:
        with pytest.raises(RobotError, match=r"does not answer on .*/nothing: switch it on"):
            kobuki.wait_until_there()
    finally:
        kobuki.close()


def test_unplugged_base_comes_back_standing(base, kobuki):
    drive_until_it_moves(base, kobuki)
    travelled = kobuki.state().travelled
    base.unplug()
    wait_for(lambda: not kobuki.alive, "the loss to be noticed")
    base.first_tick = (40_000, 40_000)  # it was switched off, too
    kobuki.drive(0.3, 0.0)
    base.command = (300, 0)  # whatever it was told before
    base.commands.clear()
    base.plug()
    wait_for(lambda: kobuki.alive, "the base")
    wait_for(lambda: base.commands, "a command")
    assert base.commands[0][1:] == (0, 0)
    assert kobuki.state().travelled == pytest.approx(travelled, abs=0.2)


def test_killed_guard_is_replaced_and_stops_the_base(base, kobuki):
    drive_until_it_moves(base, kobuki)
    base.commands.clear()
    kobuki._guard.kill()
    wait_for(lambda: stands(base), "a stop")
    drive_until_it_moves(base, kobuki)


# --- The program dies, or stands still -----------------------------------------------------------------------
DRIVER = """
import sys, time
from relmm.robot.hardware.kobuki import Kobuki
kobuki = Kobuki(sys.argv[1])
kobuki.wait_until_there()
while True:
    kobuki.drive(0.3, 0.0)
    time.sleep(0.01)
"""


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP, signal.SIGINT, signal.SIGTERM, signal.SIGSEGV])
def test_base_stops_when_its_program_is_gone(base, tmp_path, number):
    program = subprocess.Popen(
        [sys.executable, "-c", DRIVER, str(tmp_path / "kobuki")], stderr=subprocess.DEVNULL, start_new_session=True
    )
    try:
        wait_for(lambda: base.command[0] > 100, "the base to move")
        os.killpg(program.pid, number)  # as the terminal does: everything in the foreground
        wait_for(lambda: stands(base), "a stop")
        time.sleep(0.2)
        assert stands(base)
        if number == signal.SIGSTOP:
            os.killpg(program.pid, signal.SIGCONT)
            wait_for(lambda: base.command[0] > 100, "the base to move again")
    finally:
        program.kill()
        program.wait()
    wait_for(lambda: stands(base), "a stop")
