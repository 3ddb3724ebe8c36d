from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from relmm.features import DRIVE_PULSE_S, MAX_THETA_VEL, MAX_X_VEL
from relmm.policies.relmm.trail import MIRROR, TRAIL_FEATURES, Trail, last_sides

LAGS = (1, 2, 3, 5, 9, 17, 33)
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


def test_any_way_agrees_with_products_of_transforms() -> None:
    rng = np.random.default_rng(1)
    steps = list(zip(rng.uniform(-0.1, MAX_X_VEL, 40), rng.uniform(-100, 100, 40), strict=True))
    for count in (0, 1, 3, 16, 17, 40):
        for lag, features in zip(LAGS, after(*steps[:count]), strict=True):
            since, turned = np.eye(3), 0.0
            for x_vel, theta_vel in steps[max(count - lag, 0) : count]:
                forward, turn = x_vel * DRIVE_PULSE_S, math.radians(theta_vel) * DRIVE_PULSE_S
                (cos, sin), half = (math.cos(turn), math.sin(turn)), turn / 2
                step = [[cos, -sin, forward * math.cos(half)], [sin, cos, forward * math.sin(half)], [0, 0, 1]]
                since, turned = since @ np.array(step), turned + turn
            assert features[:2] == pytest.approx(np.linalg.inv(since)[:2, 2], abs=1e-5)
            assert features[2] == pytest.approx(np.clip(-turned / math.pi, -2, 2), abs=1e-5)


@pytest.mark.parametrize("index", range(len(LAGS)))
def test_each_lag_sees_its_own_last_steps_alone(index: int) -> None:
    stand = (0.0, 0.0)
    for waited in (LAGS[index] - 1, LAGS[index]):
        features = after(*[stand] * 16, (MAX_X_VEL, 0.0), *[stand] * waited)
        assert (features[index, 0] != 0) == (waited < LAGS[index])


@pytest.mark.parametrize("side", [1, -1])
def test_turns_are_limited_to_either_side(side: int) -> None:
    assert after(*[(0.0, side * MAX_THETA_VEL)] * 16)[:, 2].tolist()[-1] == -2.0 * side


def test_what_is_older_than_the_longest_lag_is_forgotten() -> None:
    recent = [(0.3, 40.0), (0.1, -70.0)] * 17
    assert after(*[(0.4, 45.0)] * 400, *recent) == pytest.approx(after(*recent), abs=1e-5)


def test_curve_ends_where_a_circle_does() -> None:
    """Sixteen small steps along an arc of 90 degrees to the left with a radius of 0.3 m."""
    features = after(*[(0.3 * math.pi / 2 / 16 / DRIVE_PULSE_S, 90 / 16 / DRIVE_PULSE_S)] * 16)
    assert features[-1] == pytest.approx([-0.3, 0.3, -0.5], abs=1e-3)


def test_mirrored_drive_has_the_mirrored_trail() -> None:
    rng = np.random.default_rng(0)
    steps = list(zip(rng.uniform(0, MAX_X_VEL, 25), rng.uniform(-MAX_THETA_VEL, MAX_THETA_VEL, 25), strict=True))
    mirrored = after(*[(forward, -turn) for forward, turn in steps])
    assert mirrored.flatten() == pytest.approx(after(*steps).flatten() * MIRROR.numpy(), abs=1e-6)


@pytest.mark.parametrize(("theta_vel", "side"), [(40.0, 1), (-40.0, -1), (0.5, 1), (-0.5, -1)])
def test_last_side_is_that_of_the_last_turn(theta_vel: float, side: int) -> None:
    trail = Trail()
    assert last_sides(torch.from_numpy(trail.features()[None])).item() == 1
    for step in (-side * 90.0, theta_vel):
        trail.moved(0.2, step)
    assert last_sides(torch.from_numpy(trail.features()[None])).item() == side


def test_copy_goes_its_own_way() -> None:
    trail = Trail()
    trail.moved(0.2, 10.0)
    other, before = trail.copy(), trail.features()
    assert np.array_equal(other.features(), before)
    other.moved(0.1, 0.0)
    assert np.array_equal(trail.features(), before)
    trail.reset()
    assert not trail.features().any()
