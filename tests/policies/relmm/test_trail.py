from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from relmm.features import DRIVE_PULSE_S, MAX_THETA_VEL, MAX_X_VEL
from relmm.policies.relmm.trail import _LAGS, MIRROR, TRAIL_FEATURES, Trail

LAGS = len(_LAGS)
LONGEST = max(_LAGS)
Motion = tuple[float, float]


def trail_of(motions: Sequence[Motion]) -> Trail:
    trail = Trail()
    for motion in motions:
        trail.moved(*motion)
    return trail


def features_of(motions: Sequence[Motion]) -> NDArray[np.float32]:
    """Forward, left and turn by lag, (lags, 3)."""
    return trail_of(motions).features().reshape(LAGS, 3)


def some_motions(seed: int, count: int) -> list[Motion]:
    low, high = (-0.1, -MAX_THETA_VEL), (MAX_X_VEL, MAX_THETA_VEL)
    return [(float(x), float(theta)) for x, theta in np.random.default_rng(seed).uniform(low, high, (count, 2))]


def by_matrices(motions: Sequence[Motion], lag: int) -> list[float]:
    """The pose `lag` steps ago as seen from now, in homogeneous coordinates, and the turn since then backwards."""
    product, turned = np.eye(3), 0.0
    for x_vel, theta_vel in motions[max(len(motions) - lag, 0) :]:
        forward, turn = x_vel * DRIVE_PULSE_S, math.radians(theta_vel) * DRIVE_PULSE_S
        cos, sin = math.cos(turn), math.sin(turn)
        chord = forward * math.cos(turn / 2), forward * math.sin(turn / 2)
        product = product @ np.array([[cos, -sin, chord[0]], [sin, cos, chord[1]], [0.0, 0.0, 1.0]])
        turned += turn
    x, y, _ = np.linalg.inv(product)[:, 2]
    return [x, y, float(np.clip(-turned / math.pi, -2.0, 2.0))]


# --- Closed forms --------------------------------------------------------------------------------------------
def test_fresh_trail_is_all_zeros_of_the_promised_type() -> None:
    features = Trail().features()
    assert features.shape == (TRAIL_FEATURES,) == MIRROR.shape
    assert features.dtype == np.float32
    assert not features.any()


def test_straight_way_lies_behind_the_robot() -> None:
    features = features_of([(0.25, 0.0)] * LONGEST)
    assert features[:, 0] == pytest.approx([-0.25 * DRIVE_PULSE_S * lag for lag in _LAGS])
    assert not features[:, 1:].any()


@pytest.mark.parametrize("theta_vel", [20.0, -20.0, MAX_THETA_VEL])
def test_turning_on_the_spot_changes_no_place(theta_vel: float) -> None:
    """After a turn to the left, where the robot looked before lies to its right."""
    features = features_of([(0.0, theta_vel)] * LONGEST)
    turns = [-theta_vel * DRIVE_PULSE_S * lag / 180 for lag in _LAGS]
    assert features[:, 2] == pytest.approx(np.clip(turns, -2.0, 2.0), abs=1e-6)
    assert not features[:, :2].any()


@pytest.mark.parametrize("theta_vel", [60.0, -60.0])
def test_arc_is_a_polygon_of_chords_on_a_circle(theta_vel: float) -> None:
    """Steps of equal length and turn: all poses lie on a circle, the chord over n steps has n times a step's angle."""
    step, turn = 0.3 * DRIVE_PULSE_S, math.radians(theta_vel) * DRIVE_PULSE_S
    radius = step / (2 * math.sin(abs(turn) / 2))
    for lag, (forward, left, turned) in zip(_LAGS, features_of([(0.3, theta_vel)] * LONGEST), strict=True):
        angle = lag * turn
        chord = 2 * radius * math.sin(abs(angle) / 2)
        assert forward == pytest.approx(-chord * math.cos(angle / 2), abs=1e-6)
        assert left == pytest.approx(chord * math.sin(angle / 2), abs=1e-6)
        assert turned == pytest.approx(-angle / math.pi, abs=1e-6)


def test_turning_left_while_driving_leaves_the_way_to_the_left() -> None:
    """As one who walks round a pillar on the left."""
    assert features_of([(MAX_X_VEL, 60.0)])[0, 1] > 0


@pytest.mark.parametrize("count", [0, 1, 3, 10, 16, 17, 40])
@pytest.mark.parametrize("seed", range(3))
def test_any_way_agrees_with_products_of_transforms(seed: int, count: int) -> None:
    motions = some_motions(seed, count)
    assert features_of(motions) == pytest.approx(np.array([by_matrices(motions, lag) for lag in _LAGS]), abs=1e-5)


# --- Lags ----------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("count", [1, 2, 3, 8, 16])
def test_lags_beyond_the_beginning_see_the_beginning(count: int) -> None:
    features = features_of([(0.25, 0.0)] * count)
    assert features[:, 0] == pytest.approx([-0.25 * DRIVE_PULSE_S * min(lag, count) for lag in _LAGS])


@pytest.mark.parametrize("index", range(LAGS))
def test_each_lag_sees_its_own_last_steps_alone(index: int) -> None:
    """One step forward, then standing still: it is seen for as many steps as the lag is long."""
    for waited in (_LAGS[index] - 1, _LAGS[index]):
        forward = features_of([(0.0, 0.0)] * LONGEST + [(0.25, 0.0)] + [(0.0, 0.0)] * waited)[:, 0]
        assert (forward[index] != 0) == (waited < _LAGS[index])


def test_what_is_older_than_the_longest_lag_is_forgotten() -> None:
    recent = some_motions(1, LONGEST)
    first, second = (features_of([*some_motions(seed, 30), *recent]) for seed in (2, 3))
    assert first[:, :2] == pytest.approx(second[:, :2], abs=1e-5)
    assert first[:, 2] == pytest.approx(second[:, 2], abs=1e-5)


@pytest.mark.parametrize(("theta_vel", "limit"), [(MAX_THETA_VEL, -2.0), (-MAX_THETA_VEL, 2.0)])
def test_turns_are_counted_beyond_a_whole_one_up_to_a_limit(theta_vel: float, limit: float) -> None:
    """A whole turn (2 half turns) is not the same as none; 16 steps are 2.4 half turns."""
    features = features_of([(0.0, theta_vel)] * LONGEST)
    assert features[-1, 2] == limit
    assert abs(features[-2, 2]) == pytest.approx(8 * MAX_THETA_VEL * DRIVE_PULSE_S / 180, abs=1e-6)


def test_way_there_and_back_cancels() -> None:
    turn = 180 / 8 / DRIVE_PULSE_S
    there = [(0.4, 0.0)] * 2 + [(0.0, turn)] * 8 + [(0.4, 0.0)] * 2
    forward, left, turned = features_of([*there, *[(0.0, 0.0)] * 4])[-1]
    assert (forward, left) == pytest.approx((0.0, 0.0), abs=1e-6)
    assert turned == pytest.approx(-1.0)


# --- Mirror, reset and copies --------------------------------------------------------------------------------
@pytest.mark.parametrize("seed", range(4))
def test_mirrored_way_has_mirrored_features(seed: int) -> None:
    motions = some_motions(seed, 25)
    mirrored = trail_of([(x_vel, -theta_vel) for x_vel, theta_vel in motions]).features()
    wanted = torch.from_numpy(trail_of(motions).features()) * MIRROR
    assert mirrored == pytest.approx(wanted.numpy(), abs=1e-6)
    assert not np.allclose(mirrored, trail_of(motions).features())


def test_reset_forgets_everything() -> None:
    trail = trail_of(some_motions(0, 5))
    trail.reset()
    assert not trail.features().any()
    trail.moved(0.3, 30.0)
    assert np.array_equal(trail.features(), trail_of([(0.3, 30.0)]).features())


def test_copies_go_their_own_ways() -> None:
    motions = some_motions(0, 20)
    trail = trail_of(motions)
    copy = trail.copy()
    assert np.array_equal(copy.features(), trail.features())
    copy.moved(0.3, 30.0)
    assert np.array_equal(trail.features(), trail_of(motions).features())
    assert np.array_equal(copy.features(), trail_of([*motions, (0.3, 30.0)]).features())
    trail.reset()
    assert np.array_equal(copy.features(), trail_of([*motions, (0.3, 30.0)]).features())


def test_features_do_not_depend_on_where_the_robot_began() -> None:
    recent, earlier = some_motions(5, LONGEST), [(0.3, 45.0)] * 400
    assert trail_of([*earlier, *recent]).features() == pytest.approx(trail_of(recent).features(), abs=1e-5)
