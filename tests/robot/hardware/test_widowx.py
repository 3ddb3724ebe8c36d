"""The arm through LeRobot's bus and the real dynamixel_sdk, on a chain that speaks protocol 2.0."""

from __future__ import annotations

import math
import time
from itertools import pairwise

import numpy as np
import pytest

pytest.importorskip("dynamixel_sdk", reason="dynamixel-sdk is not installed (the extra `hardware`)")
pytestmark = pytest.mark.slow  # real protocols in real time, which a busy machine upsets

from dynamixel_emulator import (
    DRIVE_MODE,
    GOAL_PWM,
    OPERATING_MODE,
    TEMPERATURE,
    TORQUE,
    DynamixelEmulator,
    angle_of,
    crc16,
    locobot_motors,
    packet,
)

from relmm.errors import RobotError
from relmm.geometry import arm_inverse
from relmm.robot.hardware.arm_safety import check_way, find_way
from relmm.robot.hardware.gripper import GripperControl, opening_of
from relmm.robot.hardware.motors import JOINTS, LocobotMotorsBus
from relmm.robot.hardware.widowx import SLEEP_POSE, WidowX
from relmm.robot.skills import REST_POSE

GRASP = arm_inverse(0.38, 0.03, 0.014, math.pi / 2)
ABOVE = arm_inverse(0.38, 0.03, 0.10, math.pi / 2)


@pytest.fixture
def chain(tmp_path):
    with DynamixelEmulator(tmp_path / "dxl") as emulator:
        emulator.motors[7].blocked = lambda angle: min(max(angle, angle_of(0.0)), angle_of(0.044))
        yield emulator


@pytest.fixture
def arm(chain, tmp_path):
    arm = WidowX(str(tmp_path / "dxl"), np.zeros(5))
    arm.configure()
    yield arm
    arm.close()


def angles(chain) -> np.ndarray:
    return np.array([chain.motors[i].angle for i in (1, 2, 4, 5, 6)])


def test_emulator_has_the_published_checksum():
    # The e-manual's example of a read: id 1, address 132, 4 bytes.
    assert packet(1, 0x02, bytes([0x84, 0, 4, 0])).hex(" ").upper() == "FF FF FD 00 01 07 00 02 84 00 04 00 1D 15"
    assert crc16(b"") == 0


def test_bus_finds_all_motors_at_their_rate(chain, tmp_path):
    bus = LocobotMotorsBus(str(tmp_path / "dxl"))
    bus.connect()
    assert bus.broadcast_ping() == {i: motor.table[0] + 256 * motor.table[1] for i, motor in chain.motors.items()}
    bus.set_baudrate(57_600)
    assert bus.ping("waist") is None
    bus.disconnect(disable_torque=False)


def test_configure_sets_the_chain_up_once(chain, arm, tmp_path):
    assert chain.motors[3].get(DRIVE_MODE) == 5  # reverse, time-based
    assert chain.motors[3].table[12] == 2
    assert chain.motors[7].get(OPERATING_MODE) == 16
    assert all(motor.torque for motor in chain.motors.values())
    arm.close()
    chain.log.clear()
    again = WidowX(str(tmp_path / "dxl"), np.zeros(5))
    again.configure()
    again.close()
    assert [entry for entry in chain.log if entry[1] < 64] == [], "nothing of the EEPROM is written again"
    assert not any(data == b"\0" for _, address, data in chain.log if address == TORQUE[0]), "and nothing let go"


def test_taking_hold_does_not_jerk(chain, arm):
    time.sleep(0.2)
    assert np.abs(angles(chain) - SLEEP_POSE).max() < 0.01


def test_state_tells_angles_with_true_zeros(chain, arm):
    for motor, angle in zip((1, 2, 4, 5, 6), (0.3, -0.5, 0.4, 1.0, -0.7), strict=True):
        chain.motors[motor].set(TORQUE, 0)
        chain.motors[motor].angle = angle
    assert arm.state().joints == pytest.approx([0.3, -0.5, 0.4, 1.0, -0.7], abs=0.002)


def test_arm_moves_on_a_smooth_profile_and_shows_its_goal(chain, arm):
    arm.move(REST_POSE, 0.5)
    time.sleep(0.25)
    middle = arm.state()
    assert np.abs(middle.goal - SLEEP_POSE).max() > 0.02
    assert np.abs(middle.goal - REST_POSE).max() > 0.02
    time.sleep(0.45)
    state = arm.state()
    assert state.joints == pytest.approx(REST_POSE, abs=0.01)
    assert state.goal == pytest.approx(REST_POSE, abs=0.002)
    assert chain.motors[3].angle == chain.motors[2].angle


def test_shadow_obeys_its_own_motor_only(chain, arm):
    chain.log.clear()
    arm.move(REST_POSE, 0.3)
    assert 3 not in {identifier for identifier, address, _ in chain.log if address == 116}
    time.sleep(0.5)
    assert chain.motors[3].trajectory(chain.now()) == chain.motors[2].trajectory(chain.now())


@pytest.mark.parametrize(
    ("goal", "words"),
    [
        (np.array([0.0, 0.0, 0.0, 9.0, 0.0]), "beyond its limits"),
        (arm_inverse(0.40, 0.0, 0.0, math.pi / 2), "the floor"),
        (arm_inverse(0.38, 0.0, 0.014, math.pi / 2) + np.array([0, 0.3, 0, 0, 0]), "the floor"),
        (np.array([math.pi, 0.9, 0.5, 0.5, 0.0]), "the robot itself|the floor"),
    ],
)
def test_forbidden_ways_are_refused_before_anything_moves(chain, arm, goal, words):
    chain.log.clear()
    with pytest.raises(RobotError, match=words):
        arm.move(goal, 1.0)
    assert chain.log == []


def test_way_round_the_robot_is_found():
    fallen = np.radians([0.0, -107.0, 93.0, 83.0, 0.0])  # onto the base, gripper first
    with pytest.raises(RobotError, match="the robot itself"):
        check_way(fallen, REST_POSE)
    way = [fallen, *find_way(fallen, REST_POSE)]
    assert np.array_equal(way[-1], REST_POSE)
    for start, goal in pairwise(way):
        check_way(start, goal)


def test_sag_lifts_the_goal(chain, tmp_path):
    arm = WidowX(str(tmp_path / "dxl"), np.array([0.0, -0.05, -0.03, 0.0, 0.0]))
    arm.configure()
    arm.move(ABOVE, 0.3)
    time.sleep(0.5)
    assert arm.state().goal == pytest.approx(ABOVE, abs=0.004), "what is reported is where the arm is to be"
    assert angles(chain)[1] < ABOVE[1] - 0.02
    arm.close()


# --- Gripper -------------------------------------------------------------------------------------------------
def test_crank_is_inverted():
    for opening in np.linspace(-0.004, 0.043, 20):
        assert opening_of(angle_of(opening)) == pytest.approx(opening, abs=1e-9)


def run_gripper(arm, seconds: float) -> None:
    until = time.monotonic() + seconds
    while time.monotonic() < until:
        arm.update()
        time.sleep(0.01)


def test_gripper_opens_and_rests_without_voltage(chain, arm):
    arm.set_gripper(0.044)
    run_gripper(arm, 1.0)
    assert arm.state().opening > 0.041
    assert chain.motors[7].get(GOAL_PWM) == 0


def test_gripper_notices_what_it_closes_on_and_holds_it_gently(chain, arm):
    arm.set_gripper(0.044)
    run_gripper(arm, 0.8)
    chain.motors[7].blocked = lambda angle: max(angle, angle_of(0.02))
    arm.set_gripper(-0.005)
    assert chain.motors[7].get(GOAL_PWM, signed=True) == -250
    run_gripper(arm, 1.2)
    assert arm.state().opening == pytest.approx(0.02, abs=0.001)
    assert chain.motors[7].get(GOAL_PWM, signed=True) == -150
    assert arm._gripper.obstructed


def test_stalled_gripper_gives_up_opening():
    control = GripperControl()
    control.move(0.044, 0.01, 0.0)
    assert control.pwm(0.01, 0.0) == 250
    assert control.pwm(0.0101, 0.2) == 250
    assert control.pwm(0.0101, 0.5) == 0
    assert control.obstructed


# --- Letting go, and faults ----------------------------------------------------------------------------------
def test_arm_is_limp_only_where_it_lies(chain, arm):
    arm.move(REST_POSE, 0.3)
    time.sleep(0.5)
    arm.lie_down(lambda seconds: time.sleep(seconds))
    assert np.abs(angles(chain) - SLEEP_POSE).max() < 0.02
    assert not any(motor.torque for motor in chain.motors.values())


def test_arm_that_cannot_lie_down_stays_held(chain, arm, caplog):
    arm.move(ABOVE, 0.5)
    time.sleep(0.7)
    chain.motors[4].blocked = lambda angle: min(angle, 1.0)
    arm.lie_down(lambda seconds: time.sleep(seconds))
    assert all(motor.torque for motor in chain.motors.values())
    assert "stays held" in caplog.text


def test_wrong_settings_of_a_held_arm_are_not_changed(tmp_path):
    motors = locobot_motors()
    for motor in motors.values():
        motor.angle = 0.0
        motor.set(TORQUE, 1)
    with DynamixelEmulator(tmp_path / "dxl", motors) as chain:
        arm = WidowX(str(tmp_path / "dxl"), np.zeros(5))
        with pytest.raises(RobotError, match=r"Motor 1 \(waist\) has other settings .* limp: hold the arm"):
            arm.configure()
        arm.close()
        assert all(motor.torque for motor in chain.motors.values())


def test_motor_in_error_is_one_sentence(chain, arm):
    chain.motors[4].fail(32)
    time.sleep(0.6)
    with pytest.raises(RobotError, match=r"Motor 4 \(elbow\) has switched itself off: overload"):
        arm.check_health()


def test_hot_motor_is_one_sentence(chain, arm):
    chain.motors[7].set(TEMPERATURE, 75)
    time.sleep(0.6)
    with pytest.raises(RobotError, match=r"Motor 7 \(gripper\) is at 75 degrees C, and 70 are allowed"):
        arm.check_health()


def test_missing_motor_is_one_sentence(tmp_path):
    motors = locobot_motors()
    del motors[11]
    with (
        DynamixelEmulator(tmp_path / "dxl", motors),
        pytest.raises(RobotError, match=r"Not all motors .*Missing motor IDs: - 11"),
    ):
        WidowX(str(tmp_path / "dxl"), np.zeros(5))


def test_no_adapter_is_one_sentence(tmp_path):
    with pytest.raises(RobotError, match=r"Not all motors of the arm answer on .*/nothing"):
        WidowX(str(tmp_path / "nothing"), np.zeros(5))


def test_arm_that_loses_power_is_one_sentence(chain, arm):
    chain.powered = False
    with pytest.raises(RobotError, match=r"The arm does not answer on .*: check its power and cable"):
        arm.state()


def test_late_answer_is_not_taken_for_the_next_one(chain, arm):
    before = arm.state()
    arm._bus.port_handler.ser.timeout = 0
    chain.cable.write(packet(1, 0x55, bytes([0]) + (1234).to_bytes(4, "little")))  # of a question long given up
    time.sleep(0.05)
    for _ in range(3):
        assert arm.state().joints == pytest.approx(before.joints, abs=0.01)


def test_arm_that_is_unplugged_is_one_sentence(chain, arm):
    chain.cable.unplug()
    with pytest.raises(RobotError, match=r"The arm does not answer on .*: check its power and cable"):
        arm.state()


def test_dry_run_writes_nothing(chain, tmp_path):
    arm = WidowX(str(tmp_path / "dxl"), np.zeros(5), dry=True)
    arm.configure()
    arm.move(REST_POSE, 0.3)
    arm.set_gripper(0.0)
    arm.look(0.0, 0.5)
    arm.lie_down(lambda seconds: None)
    arm.close()
    assert chain.log == []


def test_joint_table_is_complete():
    assert {joint.id for joint in JOINTS.values()} == {1, 2, 3, 4, 5, 6, 7, 10, 11}
