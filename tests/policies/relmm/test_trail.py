from __future__ import annotations

import math

import numpy as np
import pytest

from relmm.features import DRIVE_PULSE_S, MAX_THETA_VEL, MAX_X_VEL
from relmm.policies.relmm.trail import MIRROR, TRAIL_FEATURES, Trail

LAGS = (1, 2, 4, 8, 16)
STEP = MAX_X_VEL * DRIVE_PULSE_S  # m
TURN = MAX_THETA_VEL * DRIVE_PULSE_S / 180  # half turns


def after(*steps: tuple[float, float]) -> np.ndarray:
    """Features after some steps, m/s and deg/s; a row a lag."""
    trail = Trail()
    for step in steps:
        trail.moved(*step)
    return trail.features().reshape(-1, 3)


def test_fresh_trail_knows_nothing() -> None:
    assert Trail().features().tolist() == [0.0] * TRAIL_FEATURES


@pytest.mark.parametrize("count", [1, 3, 20, 50])
def test_straight_drive_leaves_the_places_behind(count: int) -> None:
    features = after(*[(MAX_X_VEL, 0.0)] * count)
    assert features[:, 0] == pytest.approx([-STEP * min(lag, count) for lag in LAGS])
    assert not features[:, 1:].any()


@pytest.mark.parametrize("count", [1, 5, 30])
def test_turn_on_the_spot_is_counted_beyond_a_round(count: int) -> None:
    features = after(*[(0.0, MAX_THETA_VEL)] * count)
    assert features[:, 2] == pytest.approx([-min(TURN * min(lag, count), 2.0) for lag in LAGS])
    assert np.abs(features[:, :2]).max() < 1e-6


def test_places_are_seen_from_where_the_robot_is_now() -> None:
    """Ahead 10 cm, then a quarter turn to the left: the start then lies 10 cm to the left."""
    quarter = [(0.0, 90 / DRIVE_PULSE_S / 4)] * 4
    features = after((0.1 / DRIVE_PULSE_S, 0.0), *quarter)
    assert features[3] == pytest.approx([0.0, 0.1, -0.5], abs=1e-6)


def test_curve_ends_where_a_circle_does() -> None:
    """Sixteen small steps along an arc of 90 degrees to the left with a radius of 0.3 m."""
    features = after(*[(0.3 * math.pi / 2 / 16 / DRIVE_PULSE_S, 90 / 16 / DRIVE_PULSE_S)] * 16)
    assert features[-1] == pytest.approx([-0.3, 0.3, -0.5], abs=1e-3)


def test_mirrored_drive_has_the_mirrored_trail() -> None:
    rng = np.random.default_rng(0)
    steps = list(zip(rng.uniform(0, MAX_X_VEL, 25), rng.uniform(-MAX_THETA_VEL, MAX_THETA_VEL, 25), strict=True))
    mirrored = after(*[(forward, -turn) for forward, turn in steps])
    assert mirrored.flatten() == pytest.approx(after(*steps).flatten() * MIRROR.numpy(), abs=1e-6)


def test_copy_goes_its_own_way() -> None:
    trail = Trail()
    trail.moved(0.2, 10.0)
    other, before = trail.copy(), trail.features()
    assert np.array_equal(other.features(), before)
    other.moved(0.1, 0.0)
    assert np.array_equal(trail.features(), before)
    trail.reset()
    assert not trail.features().any()
