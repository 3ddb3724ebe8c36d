from __future__ import annotations

import numpy as np
import pytest

from relmm.features import (
    ACTION_NAMES,
    DATASET_COLUMNS,
    DEPTH_KEY,
    DRIVE_PULSE_S,
    GRASP_X,
    GRASP_Y,
    GRID,
    IMAGE_KEY,
    MAX_THETA_VEL,
    MAX_X_VEL,
    MOTION,
    MOTION_NAMES,
    SCAN,
    SCAN_BEARINGS,
    SCAN_NAMES,
    STATE_NAMES,
    Skill,
    action_dict,
    carried_out,
    cell_to_xy,
    dataset_features,
    in_grasp_area,
    xy_to_cell,
)


def test_cells_survive_the_way_to_metres_and_back() -> None:
    assert [xy_to_cell(*cell_to_xy(cell)) for cell in range(GRID**2)] == list(range(GRID**2))


def test_all_cells_at_once_are_the_cells_one_by_one() -> None:
    cells = np.arange(GRID**2).reshape(5, 45)
    assert cell_to_xy(cells).shape == (5, 45, 2)
    np.testing.assert_array_equal(cell_to_xy(cells)[2, 7], cell_to_xy(int(cells[2, 7])))


def test_flat_index_counts_left_first_then_forward() -> None:
    first, left, forward = cell_to_xy(np.array([0, 1, GRID]))
    np.testing.assert_allclose(left - first, [0, (GRASP_Y[1] - GRASP_Y[0]) / GRID])
    np.testing.assert_allclose(forward - first, [(GRASP_X[1] - GRASP_X[0]) / GRID, 0])


@pytest.mark.parametrize(
    ("point", "cell"),
    [((0.0, 0.0), 7), ((9.0, 9.0), 224), ((0.30, -9.0), 0), ((GRASP_X[1], GRASP_Y[1]), 224), ((GRASP_X[0], 0.08), 14)],
)
def test_points_outside_go_to_the_nearest_cell(point: tuple[float, float], cell: int) -> None:
    assert xy_to_cell(*point) == cell


def test_no_point_is_farther_than_half_a_cell_from_its_cells_centre() -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform((GRASP_X[0], GRASP_Y[0]), (GRASP_X[1], GRASP_Y[1]), (500, 2))
    offsets = [cell_to_xy(xy_to_cell(*point)) - point for point in points]
    half = np.array([GRASP_X[1] - GRASP_X[0], GRASP_Y[1] - GRASP_Y[0]]) / GRID / 2
    assert np.all(np.abs(offsets) <= half + 1e-9)


def test_grasp_area_is_the_cells_and_no_more() -> None:
    assert all(in_grasp_area(*cell_to_xy(cell)) for cell in range(GRID**2))
    assert not in_grasp_area(GRASP_X[0] - 0.001, 0.0)
    assert not in_grasp_area(0.4, GRASP_Y[1] + 0.001)


def test_a_full_navigation_step_is_the_papers() -> None:
    metres, degrees = MAX_X_VEL * DRIVE_PULSE_S, MAX_THETA_VEL * DRIVE_PULSE_S
    assert metres == pytest.approx(0.106, abs=0.001)
    assert degrees == pytest.approx(27.0)


def test_action_dict_names_every_value() -> None:
    assert action_dict() == dict.fromkeys(ACTION_NAMES, 0.0)
    assert action_dict(Skill.GRASP, x=0.4, y=-0.01) == dict(zip(ACTION_NAMES, (0, 0, 1, 0.4, -0.01), strict=True))


def test_names_end_as_lerobot_wants_them() -> None:
    assert all(name.endswith((".vel", ".pos")) for name in (*ACTION_NAMES, *STATE_NAMES))


@pytest.mark.parametrize("depth", [False, True])
def test_dataset_features_have_a_name_for_each_value(depth: bool) -> None:
    features = dataset_features(depth)
    assert ("observation.images.front_depth" in features) == depth
    assert all(
        len(f["names"]) == f["shape"][0] for key, f in features.items() if key in ("action", "observation.state")
    )


def test_every_column_has_a_meaning() -> None:
    assert set(dataset_features(depth=True)) <= set(DATASET_COLUMNS)


def test_slices_of_the_state_are_where_their_names_are() -> None:
    assert STATE_NAMES[MOTION] == MOTION_NAMES
    assert STATE_NAMES[SCAN] == SCAN_NAMES
    assert len(set(STATE_NAMES)) == len(STATE_NAMES)


def test_a_scan_looks_as_far_to_the_left_as_to_the_right() -> None:
    assert len(SCAN_NAMES) == len(SCAN_BEARINGS)
    assert tuple(-bearing for bearing in reversed(SCAN_BEARINGS)) == SCAN_BEARINGS
    assert SCAN_BEARINGS[len(SCAN_BEARINGS) // 2] == 0


def test_each_picture_keeps_what_is_known_about_its_camera() -> None:
    known, unknown = dataset_features(True, {"name": "mine"}), dataset_features(True)
    for key, depth in ((IMAGE_KEY, False), (DEPTH_KEY, True)):
        assert unknown[key]["info"] == {"is_depth_map": depth}
        assert known[key]["info"] == {"is_depth_map": depth, "camera": {"name": "mine"}}


@pytest.mark.parametrize(
    ("command", "holding", "done"),
    [
        ((0.9, -200.0, 0.3, 0.0, 0.0), False, (MAX_X_VEL, -MAX_THETA_VEL, Skill.NAVIGATE, 0.0, 0.0)),
        ((-0.9, 20.0, -0.7, 0.0, 0.0), True, (0.0, 20.0, Skill.NAVIGATE, 0.0, 0.0)),
        ((0.1, 0.0, 1.2, 0.4, 0.05), False, (0.1, 0.0, Skill.GRASP, 0.4, 0.05)),
        ((0.1, 9.0, 1.0, 0.4, 0.05), True, (0.0, 0.0, Skill.NAVIGATE, 0.0, 0.0)),
        ((0.0, 0.0, 7.0, 0.4, 0.05), True, (0.0, 0.0, Skill.PLACE, 0.4, 0.05)),
        ((0.1, 9.0, 2.0, 0.4, 0.05), False, (0.0, 0.0, Skill.NAVIGATE, 0.0, 0.0)),
    ],
    ids=str,
)
def test_what_a_command_comes_to(command: tuple[float, ...], holding: bool, done: tuple[float, ...]) -> None:
    given = np.array([command])
    np.testing.assert_allclose(carried_out(given, np.array([holding])), [done])
    assert given.tolist() == [list(command)]
