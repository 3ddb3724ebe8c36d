"""The bytes of a Kobuki: golden frames, and a reader that nothing confuses."""

from __future__ import annotations

import math
import random
from dataclasses import replace

import pytest
from kobuki_emulator import TICKS_PER_METRE, KobukiEmulator, encode_frame

from relmm.robot.hardware.kobuki_protocol import (
    M_PER_TICK,
    STOP,
    FrameReader,
    Sound,
    base_control,
    decode,
    frame,
    general_output,
    request_versions,
    sound,
    sub_payloads,
    velocity,
)
from relmm.robot.hardware.odometry import Odometry

# Computed by hand from the specification; truncated toward zero, as the manufacturer's driver does.
GOLDEN = [
    (0.0, 0.0, "AA 55 06 01 04 00 00 00 00 03"),
    (0.2, 0.0, "AA 55 06 01 04 C8 00 00 00 CB"),
    (0.0, 1.0, "AA 55 06 01 04 73 00 01 00 71"),
    (-0.1, 0.0, "AA 55 06 01 04 9C FF 00 00 60"),
    (0.2, 0.5, "AA 55 06 01 04 01 01 90 01 92"),
    (0.2, -0.5, "AA 55 06 01 04 01 01 70 FE 8D"),
]


@pytest.mark.parametrize(("x_vel", "theta_vel", "expected"), GOLDEN)
def test_base_control_gives_golden_frames(x_vel, theta_vel, expected):
    assert frame(base_control(x_vel, theta_vel)).hex(" ").upper() == expected


def test_stop_is_the_golden_one():
    assert bytes.fromhex("AA 55 06 01 04 00 00 00 00 03") == STOP


def test_other_commands_have_the_specified_bytes():
    assert sound(Sound.ERROR).hex() == "040104"
    assert general_output(0x01F0).hex() == "0c02f001"
    assert request_versions().hex() == "09020b00"
    assert frame(sound(Sound.ON), general_output(0x100)).hex() == "aa5507040100" + "0c020001" + "0d"


@pytest.mark.parametrize("x_vel", [-0.15, -0.02, 0.0, 0.03, 0.2, 0.44])
@pytest.mark.parametrize("theta_vel", [-1.96, -0.4, 0.0, 0.3, 1.2, 1.96])
def test_base_drives_as_commanded_within_a_millimetre(x_vel, theta_vel):
    got = velocity(base_control(x_vel, theta_vel)[2:])
    assert got == pytest.approx((x_vel, theta_vel), abs=0.02)


def test_speeds_beyond_what_the_frame_holds_are_clamped():
    assert frame(base_control(1e6, 0.0))[5:7] == (32767).to_bytes(2, "little")
    assert frame(base_control(-1e6, 0.0))[5:7] == (-32767).to_bytes(2, "little", signed=True)


def test_distance_of_a_tick_is_the_drivers():
    assert pytest.approx(8.5292090497737556e-5) == M_PER_TICK
    assert pytest.approx(TICKS_PER_METRE, abs=0.1) == 1 / M_PER_TICK


# --- Feedback ------------------------------------------------------------------------------------------------
@pytest.fixture
def base(tmp_path):
    with KobukiEmulator(tmp_path / "kobuki", threaded=False) as emulator:
        yield emulator


def payload(base) -> bytes:
    return base._feedback()


def test_feedback_is_decoded(base):
    base.battery, base.charger, base.bumper, base.cliff, base.wheel_drop, base.over_current = 14.3, 22, 5, 2, 1, 2
    base.plant.left, base.plant.right, base.plant.heading, base.buttons = 0.1, -0.2, -12.34, 4
    told = decode(payload(base))
    assert (told.bumper, told.cliff, told.wheel_drop, told.over_current, told.charger) == (5, 2, 1, 2, 22)
    assert (told.battery, told.angle, told.buttons) == (pytest.approx(14.3), pytest.approx(-12.34), 4)
    assert (told.left, told.right) == (round(0.1 * TICKS_PER_METRE), 65536 - round(0.2 * TICKS_PER_METRE))
    assert told.firmware is None


def test_versions_come_when_asked_for(base):
    base._asked = True
    assert decode(payload(base)).firmware == (1, 2, 0)


def test_unknown_sub_payloads_are_skipped(base):
    assert decode(b"\x77\x02\x01\x02" + payload(base)) == decode(payload(base))


@pytest.mark.parametrize("broken", [b"\x01\x0e" + bytes(14), b"\x04\x07" + bytes(7), b"\x01\x0f" + b"\xff" * 15])
def test_what_cannot_be_from_a_base_is_none(broken):
    assert decode(broken) is None


def test_reader_takes_bytes_one_by_one_and_several_frames_at_once(base):
    frames = encode_frame(payload(base)) * 3
    one_by_one = FrameReader()
    assert [p for byte in frames for p in one_by_one.feed(bytes([byte]))] == [payload(base)] * 3
    assert FrameReader().feed(frames) == [payload(base)] * 3


def test_reader_finds_frames_behind_false_headers(base):
    good = encode_frame(payload(base))
    for rubbish in (
        b"\xaa",
        b"\xaa\x55",
        b"\xaa\x55\xff",
        b"\xaa\x55\x03\x01\x01",
        b"\xaa\xaa\x55",
        good[:30],
        good[:-1],
    ):
        assert FrameReader().feed(rubbish + good + good + good)[-1] == payload(base)


def test_wrong_checksum_is_refused(base):
    good = bytearray(encode_frame(payload(base)))
    for place in range(3, len(good)):
        bad = bytearray(good)
        bad[place] ^= 0x10
        assert FrameReader().feed(bytes(bad)) == []


@pytest.mark.parametrize("seed", range(3))
def test_fuzzed_stream_gives_no_wrong_packet(base, seed):
    got, sent = fuzz(base, seed, 200_000)
    assert got <= sent
    assert len(got) > 500


@pytest.mark.slow
def test_ten_million_fuzzed_bytes(base):
    got, sent = fuzz(base, 7, 10_000_000)
    assert got <= sent
    assert len(got) > 25_000


def fuzz(base, seed, size) -> tuple[set[bytes], set[bytes]]:
    """Numbered frames with damage and rubbish in pieces of any size: those that were read, and those that were sent."""
    rng, reader = random.Random(seed), FrameReader()
    got, sent, count, made, stream = set(), set(), 0, 0, bytearray()
    while made < size:
        count += 1
        base._timestamp = count % 65536
        base.plant.left, base.plant.right = count / 1e3, -count / 7e2
        good = encode_frame(payload(base))
        sent.add(good[3:-1])
        place = rng.randrange(len(good))
        damaged = good[:place] + bytes([good[place] ^ rng.randrange(1, 256)]) + good[place + 1 :]
        rubbish = rng.randbytes(rng.randrange(120))
        piece = rng.choice([good, good, good, damaged, good[:place], rubbish, rubbish + good, b"\xaa\x55" + good])
        made += len(piece)
        stream += piece
        cut = rng.randrange(len(stream) + 1)
        for told in reader.feed(bytes(stream[:cut])):
            if decode(told) is not None:
                got.add(told)
        del stream[:cut]
    assert all(list(sub_payloads(told)) for told in got)
    return got, sent


# --- Odometry ------------------------------------------------------------------------------------------------
def test_odometry_adds_up_over_wraps(base):
    base.first_tick = (65_000, 100)  # the left wraps upwards soon, the right downwards
    odometry = Odometry()
    for step in range(2000):
        base.plant.left, base.plant.right, base.plant.heading = step / 1000, -step / 2000, -step * 1.0
        odometry.update(decode(payload(base)), driving=True)
    assert odometry.travelled == pytest.approx((1.999 - 0.9995) / 2, abs=2e-4)
    assert odometry.heading == pytest.approx(-1999.0, abs=0.05)


def test_odometry_of_a_standing_base_is_its_wheels(base):
    odometry = Odometry()
    for step in range(100):
        base.plant.heading = step * 0.01  # the gyro drifts
        base.plant.right = 0.001 if step > 50 else 0.0  # something pushes
        odometry.update(decode(payload(base)), driving=False)
    assert odometry.heading == pytest.approx(math.degrees(0.001 / 0.230), abs=0.02)


def test_odometry_turns_by_its_wheels_without_a_gyro(base):
    odometry = Odometry(wheel_scale=1.1)
    for wheel in (0.0, 0.05):
        base.plant.left, base.plant.right = -wheel, wheel
        basic = next(data for identifier, data in sub_payloads(payload(base)) if identifier == 1)
        odometry.update(decode(b"\x01\x0f" + basic), driving=True)
    assert odometry.heading == pytest.approx(math.degrees(1.1 * 0.1 / 0.230), rel=1e-3)
    assert odometry.travelled == pytest.approx(0.0, abs=1e-4)


def test_odometry_goes_on_when_the_base_was_switched_off(base):
    odometry = Odometry()
    for left in (0.0, 0.4):
        base.plant.left = base.plant.right = left
        odometry.update(decode(payload(base)), driving=True)
    odometry.forget_position()
    for left in (0.0, 0.3):
        base.plant.left = base.plant.right = left
        odometry.update(decode(payload(base)), driving=True)
    assert odometry.travelled == pytest.approx(0.7, abs=1e-3)


@pytest.mark.parametrize("bit", range(16))
def test_a_flipped_bit_of_an_encoder_does_not_carry_the_robot_away(base, bit):
    """Two flips of one bit of two bytes pass the check sum."""
    odometry = Odometry()
    for step in range(100):
        base.plant.left = base.plant.right = step / 100
        feedback = decode(payload(base))
        odometry.update(replace(feedback, left=feedback.left ^ 1 << bit) if step == 50 else feedback, driving=True)
    assert odometry.travelled == pytest.approx(0.99, abs=0.025), "at most the way of two readings is lost"
