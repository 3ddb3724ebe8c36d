from __future__ import annotations

import numpy as np
import pytest

from relmm.features import SCAN_BEARINGS, SCAN_RANGE
from relmm.geometry import CAMERAS, CameraGeometry, arm_forward, arm_inverse
from relmm.robot.body import BodyState
from relmm.robot.sensing import (
    OBSTACLE_HEIGHT,
    OBSTACLE_RADIUS,
    OWN_RADIUS,
    ContactDetector,
    ObstacleDetector,
    grips_something,
    sees_held_object,
)
from relmm.robot.skills import PRESENT_POSE, REST_POSE

REACHING = arm_inverse(0.40, 0.0, 0.10, pitch=np.pi / 2)


@pytest.fixture(params=CAMERAS)
def camera(request: pytest.FixtureRequest) -> CameraGeometry:
    return CAMERAS[request.param]


def rays(camera: CameraGeometry) -> np.ndarray:
    width, height = camera.size
    return camera.rays(np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1))


def floor_depth(camera: CameraGeometry, height: float = 0.0) -> np.ndarray:
    """What a bare plane `height` m above the floor looks like, in mm; beyond 5 m nothing is measured."""
    down = np.minimum(rays(camera)[..., 2], -1e-9)
    depth = (height - camera.position[2]) / down * 1000
    return np.where(depth < 5000, depth, 0).astype(np.uint16)


def box_depth(camera: CameraGeometry, front: float, half_width: float, top: float) -> np.ndarray:
    """The front of a box `front` m before the robot's centre, on the floor."""
    directions = rays(camera)
    depth = (front - camera.position[0]) / np.maximum(directions[..., 0], 1e-9)
    points = np.array(camera.position) + directions * depth[..., None]
    hit = (np.abs(points[..., 1]) < half_width) & (points[..., 2] > 0) & (points[..., 2] < top)
    return np.where(hit, depth * 1000, floor_depth(camera)).astype(np.uint16)


# --- Grasp judgement -----------------------------------------------------------------------------------------
@pytest.mark.parametrize(("opening", "expected"), [(0.0, False), (0.003, False), (0.014, True), (0.03, True)])
def test_fingers_kept_apart_grip_something(opening: float, expected: bool) -> None:
    assert grips_something(opening) == expected


def test_an_empty_gripper_shows_the_floor(camera: CameraGeometry) -> None:
    assert not sees_held_object(floor_depth(camera), camera, PRESENT_POSE, 0.03)


def test_something_between_the_pads_is_seen(camera: CameraGeometry) -> None:
    tool_height = arm_forward(PRESENT_POSE)[3, 2]
    assert sees_held_object(floor_depth(camera, tool_height), camera, PRESENT_POSE, 0.03)


def test_something_far_behind_the_gripper_is_not_held(camera: CameraGeometry) -> None:
    tool_height = arm_forward(PRESENT_POSE)[3, 2]
    assert not sees_held_object(floor_depth(camera, tool_height - 0.1), camera, PRESENT_POSE, 0.03)


def test_nothing_measured_is_nothing_seen(camera: CameraGeometry) -> None:
    assert not sees_held_object(np.zeros(camera.size[::-1], np.uint16), camera, PRESENT_POSE, 0.03)


def test_closed_fingers_do_not_break_the_judgement(camera: CameraGeometry) -> None:
    assert not sees_held_object(floor_depth(camera), camera, PRESENT_POSE, 0.0)


# --- Collision avoidance -------------------------------------------------------------------------------------
def test_bare_floor_is_free(camera: CameraGeometry) -> None:
    assert not ObstacleDetector(camera).obstructed(floor_depth(camera))


def test_nothing_measured_is_free(camera: CameraGeometry) -> None:
    assert not ObstacleDetector(camera).obstructed(np.zeros(camera.size[::-1], np.uint16))


@pytest.mark.parametrize("front", [0.27, 0.30, 0.34])
def test_a_near_wall_obstructs(camera: CameraGeometry, front: float) -> None:
    assert ObstacleDetector(camera).obstructed(box_depth(camera, front, 2.0, 1.0))


@pytest.mark.parametrize("front", [OBSTACLE_RADIUS + 0.03, 0.6, 1.5])
def test_a_distant_wall_does_not(camera: CameraGeometry, front: float) -> None:
    assert not ObstacleDetector(camera).obstructed(box_depth(camera, front, 2.0, 1.0))


def test_a_thin_post_obstructs(camera: CameraGeometry) -> None:
    assert ObstacleDetector(camera).obstructed(box_depth(camera, 0.32, 0.03, 1.0))


@pytest.mark.parametrize("height", [0.02, 0.036, 0.06])
def test_things_as_low_as_objects_do_not_obstruct(camera: CameraGeometry, height: float) -> None:
    assert not ObstacleDetector(camera).obstructed(box_depth(camera, 0.32, 0.3, height))


def test_a_few_noisy_pixels_do_not_obstruct(camera: CameraGeometry) -> None:
    depth = floor_depth(camera)
    wall = box_depth(camera, 0.3, 2.0, 1.0)
    rows, columns = np.nonzero(wall != depth)
    chosen = np.random.default_rng(0).choice(len(rows), 3, replace=False)
    depth[rows[chosen], columns[chosen]] = wall[rows[chosen], columns[chosen]]
    assert not ObstacleDetector(camera).obstructed(depth)


# --- The arm's way -------------------------------------------------------------------------------------------
@pytest.mark.parametrize("front", [0.36, 0.40])
def test_a_wall_through_the_arm_obstructs_it(camera: CameraGeometry, front: float) -> None:
    assert ObstacleDetector(camera).obstructs_arm(box_depth(camera, front, 2.0, 1.0), [REACHING])


def test_one_obstructed_pose_is_enough(camera: CameraGeometry) -> None:
    depth = box_depth(camera, 0.38, 2.0, 1.0)
    assert not ObstacleDetector(camera).obstructs_arm(depth, [REST_POSE])
    assert ObstacleDetector(camera).obstructs_arm(depth, [REST_POSE, REACHING])


@pytest.mark.parametrize(("front", "half_width", "top"), [(0.45, 2.0, 1.0), (1.0, 2.0, 1.0), (0.36, 0.5, 0.06)])
def test_what_is_farther_away_or_as_low_as_objects_does_not_obstruct_the_arm(
    camera: CameraGeometry, front: float, half_width: float, top: float
) -> None:
    assert not ObstacleDetector(camera).obstructs_arm(box_depth(camera, front, half_width, top), [REACHING])


def test_what_stands_beside_the_arm_does_not_obstruct_it(camera: CameraGeometry) -> None:
    post = box_depth(camera, 0.36, 0.03, 0.3)
    beside = arm_inverse(0.38, 0.14, 0.10, pitch=np.pi / 2)
    assert ObstacleDetector(camera).obstructs_arm(post, [REACHING])
    assert not ObstacleDetector(camera).obstructs_arm(post, [beside])


def test_bare_floor_and_nothing_measured_do_not_obstruct_the_arm(camera: CameraGeometry) -> None:
    for depth in (floor_depth(camera), np.zeros(camera.size[::-1], np.uint16)):
        assert not ObstacleDetector(camera).obstructs_arm(depth, [REACHING, PRESENT_POSE])


# --- Scan ----------------------------------------------------------------------------------------------------
LEVEL = CameraGeometry(position=(0.05, 0.0, 0.5), pitch=0.0, fov=(60.0, 60.0))
BEARINGS = np.array(SCAN_BEARINGS)


def post_depth(camera: CameraGeometry, distance: float, bearing: float, half_width: float = 0.03) -> np.ndarray:
    """A flat post, 1 m high, that faces the robot's centre."""
    facing = np.array([np.cos(np.radians(bearing)), np.sin(np.radians(bearing)), 0.0])
    directions, origin = rays(camera), np.array(camera.position)
    depth = (distance - origin @ facing) / np.maximum(directions @ facing, 1e-9)
    points = origin + directions * depth[..., None]
    beside = points[..., :2] @ np.array([-facing[1], facing[0]])
    hit = (np.abs(beside) < half_width) & (points[..., 2] > 0) & (points[..., 2] < 1.0)
    return np.where(hit, depth * 1000, floor_depth(camera)).astype(np.uint16)


@pytest.mark.parametrize("front", [0.4, 0.6])
def test_a_scan_of_a_wall_is_its_distance_in_each_direction(camera: CameraGeometry, front: float) -> None:
    scan = ObstacleDetector(camera).scan(box_depth(camera, front, 2.0, 1.0))
    seen = scan < SCAN_RANGE
    assert set(np.diff(BEARINGS[seen])) == {3}
    assert set(range(-27, 28, 3)) <= set(BEARINGS[seen])
    nearest, farthest = (front / np.cos(np.radians(np.abs(BEARINGS[seen]) + edge)) for edge in (-1.5, 1.5))
    nearest[BEARINGS[seen] == 0] = front
    assert np.all(scan[seen] > nearest - 0.003)
    assert np.all(scan[seen] < farthest + 0.003)


@pytest.mark.parametrize("bearing", [-21, -12, 0, 9, 21])
@pytest.mark.parametrize("distance", [0.32, 0.5, 0.7])
def test_a_post_is_seen_where_it_stands_and_nowhere_else(camera: CameraGeometry, distance: float, bearing: int) -> None:
    scan = ObstacleDetector(camera).scan(post_depth(camera, distance, bearing))
    assert scan[bearing == BEARINGS] == pytest.approx(distance, abs=0.003)
    half = np.degrees(np.arctan2(0.03, distance))
    assert set(scan[np.abs(BEARINGS - bearing) > half + 1.5]) == {SCAN_RANGE}


def test_the_nearer_of_two_things_counts(camera: CameraGeometry) -> None:
    depths = [post_depth(camera, 0.4, 0.0), box_depth(camera, 0.6, 2.0, 1.0)]
    scan = ObstacleDetector(camera).scan(np.minimum(*depths))
    assert scan[BEARINGS == 0] == pytest.approx(0.4, abs=0.003)
    assert scan[BEARINGS == 12] == pytest.approx(0.6 / np.cos(np.radians(12)), abs=0.01)


def test_a_scan_without_obstacles_reaches_its_range(camera: CameraGeometry) -> None:
    low = box_depth(camera, 0.4, 0.5, OBSTACLE_HEIGHT[0] - 0.01)
    for depth in (floor_depth(camera), np.zeros(camera.size[::-1], np.uint16), low):
        assert set(ObstacleDetector(camera).scan(depth)) == {SCAN_RANGE}


def test_the_robot_does_not_scan_itself(camera: CameraGeometry) -> None:
    depth = box_depth(camera, OWN_RADIUS - 0.02, 0.08, 1.0)
    assert (depth != floor_depth(camera)).any()
    assert set(ObstacleDetector(camera).scan(depth)) == {SCAN_RANGE}


@pytest.mark.parametrize(("pixels", "distance"), [(2, SCAN_RANGE), (3, 0.6), (4, 0.6)])
def test_a_direction_needs_three_points(camera: CameraGeometry, pixels: int, distance: float) -> None:
    wall, depth = box_depth(camera, 0.6, 2.0, 1.0), np.zeros(camera.size[::-1], np.uint16)
    points = np.column_stack([np.full(pixels, 0.6), np.zeros(pixels), 0.1 + 0.03 * np.arange(pixels)])
    column, row = np.rint(camera.project(points)).astype(int).T
    depth[row, column] = wall[row, column]
    scan = ObstacleDetector(camera).scan(depth)
    assert scan[BEARINGS == 0] == pytest.approx(distance, abs=0.003)
    assert set(scan[BEARINGS != 0]) == {SCAN_RANGE}


@pytest.mark.parametrize(("front", "distance"), [(2.5, 2.5), (SCAN_RANGE + 0.1, SCAN_RANGE)])
def test_a_scan_ends_at_its_range(front: float, distance: float) -> None:
    scan = ObstacleDetector(LEVEL).scan(box_depth(LEVEL, front, 5.0, 0.65))
    assert scan[BEARINGS == 0] == pytest.approx(distance, abs=0.003)


def test_what_passes_over_the_robot_is_not_scanned() -> None:
    depth = box_depth(LEVEL, 1.5, 5.0, 1.2)
    below = np.array(LEVEL.position)[2] + rays(LEVEL)[..., 2] * depth / 1000 < OBSTACLE_HEIGHT[1]
    assert set(ObstacleDetector(LEVEL).scan(np.where(below, 0, depth))) == {SCAN_RANGE}


# --- Stopping on contact -------------------------------------------------------------------------------------
def state(joint: float, goal: float, travelled: float = 0.0, heading: float = 0.0) -> BodyState:
    return BodyState(0.0, travelled, heading, np.full(5, joint), np.full(5, goal), 0.04, 0)


def test_a_fast_arm_that_trails_its_goal_by_one_look_meets_nothing() -> None:
    contact = ContactDetector(state(0.0, 0.0))
    assert not any(contact.touches(state(0.12 * max(look - 1, 0), 0.12 * look)) for look in range(10))


def test_an_arm_that_stays_behind_meets_something() -> None:
    contact = ContactDetector(state(0.0, 0.0))
    assert [contact.touches(state(0.0, 0.05 * look)) for look in range(4)] == [False, False, False, True]


@pytest.mark.parametrize(
    ("travelled", "heading", "touches"), [(-0.003, 0, True), (0, 2, True), (-0.0005, 0.5, False), (0.003, 0, False)]
)
def test_an_arm_that_pushes_the_base_away_meets_something(travelled: float, heading: float, touches: bool) -> None:
    contact = ContactDetector(state(0.0, 0.0))
    assert contact.touches(state(0.0, 0.0, travelled, heading)) == touches
