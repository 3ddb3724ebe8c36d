"""The skills on the simulated body: the sensors decide, the simulator's ground truth checks."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from dataclasses import replace

import mujoco
import numpy as np
import pytest

from relmm.features import BASKET_XY, DRIVE_PULSE_S, GRASP_X, MAX_THETA_VEL, MAX_X_VEL, SCAN_BEARINGS
from relmm.geometry import camera_geometry, moved
from relmm.robot.body import BUMPER_CENTRE, MAX_OPENING, BodyState
from relmm.robot.sensing import ObstacleDetector
from relmm.robot.skills import REST_POSE, Skills
from relmm.sim.body import SimBody
from relmm.sim.rooms import make_room, set_objects

REACHABLE = [(0.32, 0.0), (0.38, 0.07), (0.38, -0.07), (0.45, 0.0), (0.46, 0.07), (0.31, -0.07)]


@pytest.fixture(scope="module")
def shared_body() -> Iterator[SimBody]:
    body = SimBody(make_room("no_obstacles", num_objects=3, robot_clearance=0.8), camera_geometry("paper"))
    yield body
    body.close()


@pytest.fixture
def body(shared_body: SimBody) -> SimBody:
    shared_body.reset(np.random.default_rng(0))
    return shared_body


@pytest.fixture
def skills(body: SimBody) -> Skills:
    skills = Skills(body, np.random.default_rng(0))
    skills.rest()
    return skills


def put_object(body: SimBody, x: float, y: float) -> None:
    """Lay object 0 down in front of the robot (m, robot frame), the others where they are."""
    robot_x, robot_y, heading = body.truth.robot()
    cos, sin = np.cos(heading), np.sin(heading)
    poses = np.column_stack([body.truth.objects()[:, :2], np.zeros(body.room.num_objects)])
    poses[0, :2] = robot_x + cos * x - sin * y, robot_y + sin * x + cos * y
    set_objects(body.model, body.data, poses)
    body.wait(0.3)


def put_robot(body: SimBody, x: float, y: float, heading: float) -> None:
    start = body.model.joint("locobot/base").qposadr[0]
    body.data.qpos[start : start + 2] = x, y
    body.data.qpos[start + 3 : start + 7] = np.cos(heading / 2), 0, 0, np.sin(heading / 2)
    mujoco.mj_forward(body.model, body.data)
    body.wait(0.02)


def put_robot_with_object(body: SimBody, x: float) -> None:
    """Face the front wall from (x, 0), with object 0 where it was to the robot."""
    place = body.truth.objects_in_robot_frame()[0]
    start = body.model.joint("object_00").qposadr[0]
    body.data.qpos[start : start + 3] = np.array([x, 0.0, 0.0]) + place
    put_robot(body, x, 0.0, 0.0)


def displacement(body: SimBody, before: tuple[float, float, float]) -> tuple[float, float, float]:
    """How far the robot has moved: forward and left in m, and turned in degrees."""
    x, y, heading = before
    new_x, new_y, new_heading = body.truth.robot()
    forward = np.cos(heading) * (new_x - x) + np.sin(heading) * (new_y - y)
    left = np.cos(heading) * (new_y - y) - np.sin(heading) * (new_x - x)
    return forward, left, float(np.degrees((new_heading - heading + np.pi) % (2 * np.pi) - np.pi))


# --- Navigation ----------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("x_vel", "theta_vel", "forward", "turned"),
    [
        (0.0, 0.0, 0.0, 0.0),
        (MAX_X_VEL, 0.0, 0.106, 0.0),
        (MAX_X_VEL / 2, 0.0, 0.053, 0.0),
        (0.0, MAX_THETA_VEL, 0.0, 27.0),
        (0.0, -MAX_THETA_VEL, 0.0, -27.0),
        (0.0, MAX_THETA_VEL / 2, 0.0, 13.5),
        (MAX_X_VEL, MAX_THETA_VEL, 0.103, 27.0),
    ],
)
def test_a_navigation_step_moves_as_the_papers_robot(
    body: SimBody, skills: Skills, x_vel: float, theta_vel: float, forward: float, turned: float
) -> None:
    start, began = body.truth.robot(), body.state().time
    skills.navigate(x_vel, theta_vel)
    moved = displacement(body, start)
    assert moved[0] == pytest.approx(forward, abs=0.006)
    assert moved[2] == pytest.approx(turned, abs=2.0)
    assert body.state().time - began == pytest.approx(0.5)


def test_turning_left_while_driving_goes_left(body: SimBody, skills: Skills) -> None:
    start = body.truth.robot()
    skills.navigate(MAX_X_VEL, MAX_THETA_VEL)
    assert displacement(body, start)[1] > 0.01


def test_the_base_stands_still_after_each_step(body: SimBody, skills: Skills) -> None:
    rng = np.random.default_rng(1)
    for _ in range(5):
        skills.navigate(rng.uniform(0, MAX_X_VEL), rng.uniform(-MAX_THETA_VEL, MAX_THETA_VEL))
        before = body.truth.robot()
        body.wait(0.5)
        assert body.truth.robot() == pytest.approx(before, abs=0.002)


# --- Motion --------------------------------------------------------------------------------------------------
class ExactBody:
    """Wheels that do at once what they are told, and a camera that sees nothing."""

    camera = camera_geometry("paper")

    def __init__(self) -> None:
        self._velocity = (0.0, 0.0)
        self._state = BodyState(0.0, 7.0, -300.0, REST_POSE, REST_POSE, MAX_OPENING, 0)  # it has a life behind it

    def drive(self, x_vel: float, theta_vel: float) -> None:
        self._velocity = x_vel, theta_vel

    def state(self) -> BodyState:
        return self._state

    def capture(self) -> tuple[np.ndarray, np.ndarray]:
        return np.zeros((100, 100, 3), np.uint8), np.zeros((100, 100), np.uint16)

    def wait(self, seconds: float) -> None:
        x_vel, theta_vel = self._velocity
        travelled, heading = self._state.travelled + x_vel * seconds, self._state.heading + theta_vel * seconds
        self._state = replace(self._state, travelled=travelled, heading=heading)


def test_motion_of_an_arc_is_that_of_the_circle() -> None:
    skills = Skills(ExactBody(), np.random.default_rng(0))  # type: ignore[arg-type]
    assert skills.motion().tolist() == [0.0, 0.0, 0.0]
    for x_vel, theta_vel in ((0.4, 100.0), (0.4, -100.0), (0.1, 25.0)):
        skills.navigate(x_vel, theta_vel)
        turn, radius = np.radians(theta_vel * DRIVE_PULSE_S), x_vel / np.radians(theta_vel)
        expected = radius * np.sin(turn), radius * (1 - np.cos(turn)), np.degrees(turn)
        np.testing.assert_allclose(skills.motion(), expected, rtol=1e-3)
    skills.navigate(0.3, 0.0)
    np.testing.assert_allclose(skills.motion(), [0.3 * DRIVE_PULSE_S, 0, 0], atol=1e-9)
    skills.navigate(0.0, 0.0)
    assert skills.motion().tolist() == [0.0, 0.0, 0.0]


@pytest.mark.parametrize(("x_vel", "theta_vel"), [(MAX_X_VEL, MAX_THETA_VEL), (0.3, -60.0), (0.0, 90.0)])
def test_motion_is_how_the_robot_has_moved(body: SimBody, skills: Skills, x_vel: float, theta_vel: float) -> None:
    start = body.truth.robot()
    skills.navigate(x_vel, theta_vel)
    forward, left, turned = displacement(body, start)
    assert skills.motion()[:2] == pytest.approx((forward, left), abs=0.003)
    assert skills.motion()[2] == pytest.approx(turned, abs=1.5)


@pytest.mark.parametrize(("x", "x_vel"), [(1.1, MAX_X_VEL), (1.2, 0.0), (1.25, MAX_X_VEL)])
def test_motion_tells_of_turns_away_from_obstacles(body: SimBody, x: float, x_vel: float) -> None:
    """The whole step counts: the drive, the way back from a wall, and the turn after both."""
    put_robot(body, x, 0.0, 0.0)
    skills, before = Skills(body, np.random.default_rng(0)), body.truth.robot()
    skills.navigate(x_vel, 0.0)
    forward, left, turned = displacement(body, before)
    assert abs(turned) > 20
    assert skills.motion()[2] == pytest.approx(turned, abs=3.0)
    assert skills.motion()[:2] == pytest.approx((forward, left), abs=0.03)


@pytest.mark.parametrize("place", [(0.38, 0.05), None])
def test_an_arm_that_moves_reports_no_motion(body: SimBody, skills: Skills, place: tuple[float, float] | None) -> None:
    skills.navigate(0.4, 60.0)
    if place is not None:
        put_object(body, *place)
    assert skills.grasp(0.38, 0.05) == (place is not None)
    assert np.abs(skills.motion() / (0.003, 0.003, 0.5)).max() < 1
    if place is not None:
        skills.navigate(0.4, 60.0)
        skills.place(0.38, 0.0)
        assert np.abs(skills.motion() / (0.003, 0.003, 0.5)).max() < 1


def test_motions_add_up_to_the_robots_way(body: SimBody, skills: Skills) -> None:
    """Along the walls, where it turns away, and with attempts to grasp in between."""
    rng, pose = np.random.default_rng(2), np.array(body.truth.robot())
    for step in range(60):
        if step % 10 == 9:
            skills.grasp(0.38, 0.0)
        else:
            skills.navigate(rng.uniform(0, MAX_X_VEL), rng.uniform(-MAX_THETA_VEL, MAX_THETA_VEL))
        forward, left, turned = skills.motion()
        pose = moved(pose, np.array([forward, left, np.radians(turned)]))
    x, y, heading = body.truth.robot()
    assert pose[:2] == pytest.approx((x, y), abs=0.06)
    assert np.degrees((pose[2] - heading + np.pi) % (2 * np.pi) - np.pi) == pytest.approx(0.0, abs=8.0)


def test_a_scan_sees_the_wall(body: SimBody, skills: Skills) -> None:
    put_robot(body, 0.5, 0.0, 0.0)
    skills.forget_picture()
    middle = len(SCAN_BEARINGS) // 2
    assert skills.scan()[middle] == pytest.approx(1.0, abs=0.02)
    left = middle + SCAN_BEARINGS[middle:].index(15)
    assert skills.scan()[left] == pytest.approx(1.0 / np.cos(np.radians(15)), abs=0.03)


# --- Avoidance -----------------------------------------------------------------------------------------------
def test_a_robot_that_faces_a_wall_turns_until_its_way_is_free(body: SimBody, skills: Skills) -> None:
    put_robot(body, 1.2, 0.0, 0.0)
    assert ObstacleDetector(body.camera).obstructed(body.capture()[1])
    skills.navigate(0.0, 0.0)
    assert not ObstacleDetector(body.camera).obstructed(body.capture()[1])
    assert abs(np.degrees(body.truth.robot()[2])) > 20


def test_the_way_it_turns_is_random_and_repeats_with_the_seed(body: SimBody) -> None:
    def turned(seed: int) -> float:
        skills = Skills(body, np.random.default_rng(seed))
        put_robot(body, 1.2, 0.0, 0.0)
        skills.navigate(0.0, 0.0)
        return float(np.sign(body.truth.robot()[2]))

    directions = [turned(seed) for seed in range(6)]
    assert set(directions) == {-1.0, 1.0}
    assert [turned(seed) for seed in range(6)] == directions


def test_it_does_not_change_direction_while_turning_away(body: SimBody, skills: Skills) -> None:
    put_robot(body, 1.3, 1.3, np.pi / 4)  # a corner
    headings = []
    drive = body.drive
    body.drive = lambda x_vel, theta_vel: (headings.append(theta_vel), drive(x_vel, theta_vel))  # type: ignore[method-assign]
    skills.navigate(0.0, 0.0)
    del body.drive
    turns = [theta for theta in headings if theta]
    assert len(turns) >= 2
    assert len(set(turns)) == 1


def test_it_gives_up_with_a_warning_when_boxed_in(
    body: SimBody, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(ObstacleDetector, "obstructed", lambda self, depth: True)
    skills = Skills(body, np.random.default_rng(0))
    with caplog.at_level(logging.WARNING):
        skills.navigate(0.0, 0.0)
    assert "in every direction" in caplog.text


def test_free_floor_needs_no_turn(body: SimBody, skills: Skills) -> None:
    start = body.truth.robot()
    skills.navigate(0.0, 0.0)
    assert displacement(body, start) == pytest.approx((0, 0, 0), abs=0.5)


def test_a_bumped_wall_is_reported_and_backed_off_from(body: SimBody, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ObstacleDetector, "obstructed", lambda self, depth: False)
    put_robot(body, 1.5 - 0.178 - 0.03, 0.0, 0.0)
    skills = Skills(body, np.random.default_rng(0))
    skills.navigate(MAX_X_VEL, 0.0)
    assert skills.bumper == BUMPER_CENTRE
    assert body.truth.robot()[0] < 1.5 - 0.178 - 0.02
    assert abs(np.degrees(body.truth.robot()[2])) > 15
    skills.navigate(0.0, 0.0)
    assert skills.bumper == 0


def test_random_driving_never_leaves_the_room_nor_gets_stuck(body: SimBody, skills: Skills) -> None:
    rng = np.random.default_rng(2)
    places = []
    for _ in range(150):
        skills.navigate(rng.uniform(0, MAX_X_VEL), rng.uniform(-MAX_THETA_VEL, MAX_THETA_VEL))
        places.append(body.truth.robot()[:2])
    assert np.abs(places).max() < 1.5 - 0.17
    assert np.ptp(places, axis=0).min() > 0.8


# --- Grasps --------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("place", REACHABLE)
def test_an_object_is_picked_up_at_its_own_place(body: SimBody, skills: Skills, place: tuple[float, float]) -> None:
    put_object(body, *place)
    assert skills.grasp(*place)
    assert skills.holding
    assert body.truth.held()


@pytest.mark.parametrize("place", REACHABLE)
def test_an_empty_floor_gives_nothing(body: SimBody, skills: Skills, place: tuple[float, float]) -> None:
    assert not skills.grasp(*place)
    assert not skills.holding
    assert not body.truth.held()
    assert body.state().gripper == pytest.approx(MAX_OPENING, abs=0.002)


def test_beside_an_object_nothing_is_picked_up(body: SimBody, skills: Skills) -> None:
    put_object(body, 0.38, 0.05)
    assert not skills.grasp(0.38, -0.03)
    assert not body.truth.held()


def test_the_judgement_is_the_truth_at_any_offset(body: SimBody) -> None:
    rng = np.random.default_rng(3)
    judged, true = [], []
    for _ in range(12):
        body.reset(rng)
        skills = Skills(body, rng)
        skills.rest()
        put_object(body, 0.38, 0.0)
        judged.append(skills.grasp(0.38 + rng.uniform(-0.05, 0.05), rng.uniform(-0.04, 0.04)))
        true.append(body.truth.held())
    assert judged == true
    assert 0 < sum(true) < len(true)


def test_after_a_grasp_the_arm_rests(body: SimBody, skills: Skills) -> None:
    for _ in range(2):
        put_object(body, 0.4, 0.0)
        skills.grasp(0.4, 0.0)
        np.testing.assert_allclose(body.state().joints, REST_POSE, atol=0.05)


def test_a_lost_object_is_noticed(body: SimBody, skills: Skills) -> None:
    put_object(body, 0.4, 0.0)
    assert skills.grasp(0.4, 0.0)
    put_object(body, -0.6, 0.0)
    body.wait(0.5)
    assert not skills.holding
    assert not body.truth.held()


def test_an_object_stays_held_while_driving(body: SimBody, skills: Skills) -> None:
    put_object(body, 0.4, 0.0)
    assert skills.grasp(0.4, 0.0)
    rng = np.random.default_rng(4)
    for _ in range(20):
        skills.navigate(rng.uniform(0, MAX_X_VEL), rng.uniform(-MAX_THETA_VEL, MAX_THETA_VEL))
    assert skills.holding
    assert body.truth.held()


def wall_force(body: SimBody) -> float:
    """Force between the robot and the wall in front of it, N."""
    force, total = np.zeros(6), 0.0
    wall = body.model.geom("wall_front").id
    for index in np.flatnonzero((body.data.contact.geom == wall).any(axis=1)):
        mujoco.mj_contactForce(body.model, body.data, index, force)
        total += float(force[0])
    return total


@pytest.mark.parametrize(("distance", "x"), [(0.36, 0.38), (0.40, GRASP_X[1]), (0.44, GRASP_X[1])])
def test_the_arm_stops_where_it_meets_a_wall(
    body: SimBody, skills: Skills, monkeypatch: pytest.MonkeyPatch, distance: float, x: float
) -> None:
    monkeypatch.setattr(ObstacleDetector, "obstructs_arm", lambda self, depth, poses: False)  # it has not seen the wall
    put_robot(body, 1.5 - distance, 0.0, 0.0)
    forces: list[float] = []
    body.watcher = lambda: forces.append(wall_force(body))
    began = body.state().time
    assert not skills.grasp(x, 0.0)
    body.watcher = None
    assert body.state().time - began < 2.5, "the whole attempt takes 3 s and more"
    assert 0.0 < 0.02 * np.count_nonzero(forces) < 0.2, "s of contact; without a stop 0.3 and more"
    assert np.convolve(forces, np.ones(5) / 5).max() < 60, "N over 0.1 s; the first touch is harder"
    np.testing.assert_allclose(body.state().joints, REST_POSE, atol=0.05)
    assert body.state().gripper == pytest.approx(MAX_OPENING, abs=0.002)


@pytest.mark.parametrize("distance", [0.38, 0.40, 0.44])  # farther away than where a navigation step would turn
def test_nothing_moves_where_a_wall_is_seen_in_the_arms_way(body: SimBody, skills: Skills, distance: float) -> None:
    put_robot(body, 1.5 - distance, 0.0, 0.0)
    assert not ObstacleDetector(body.camera).obstructed(body.capture()[1])
    state = body.data.qpos.copy()
    assert not skills.grasp(GRASP_X[1], 0.0)
    np.testing.assert_array_equal(body.data.qpos, state)


def test_grasps_beside_a_wall_meet_nothing(body: SimBody, skills: Skills) -> None:
    put_robot(body, 1.5 - 0.56, 0.0, 0.0)
    put_object(body, GRASP_X[1], 0.0)
    forces: list[float] = []
    body.watcher = lambda: forces.append(wall_force(body))
    assert skills.grasp(GRASP_X[1], 0.0)
    body.watcher = None
    assert max(forces) == 0.0


# --- Placements ----------------------------------------------------------------------------------------------
@pytest.mark.parametrize("place", [(0.33, 0.05), (0.45, -0.06)])
def test_an_object_is_put_down_where_it_was_asked_for(
    body: SimBody, skills: Skills, place: tuple[float, float]
) -> None:
    put_object(body, 0.4, 0.0)
    assert skills.grasp(0.4, 0.0)
    skills.place(*place)
    x, y, z = body.truth.objects_in_robot_frame()[0]
    assert (x, y) == pytest.approx(place, abs=0.03)
    assert z < 0.03
    assert not skills.holding
    assert not body.truth.held()


def test_an_object_stays_held_where_the_way_is_obstructed(body: SimBody, skills: Skills) -> None:
    put_object(body, 0.4, 0.0)
    assert skills.grasp(0.4, 0.0)
    put_robot_with_object(body, 1.5 - 0.40)
    skills.place(GRASP_X[1], 0.0)
    assert skills.holding
    np.testing.assert_allclose(body.state().joints, REST_POSE, atol=0.05)


def test_an_object_is_dropped_into_the_basket(body: SimBody, skills: Skills) -> None:
    put_object(body, 0.4, 0.0)
    assert skills.grasp(0.4, 0.0)
    skills.place_in_basket()
    assert body.truth.in_basket().tolist() == [0]
    assert not skills.holding
    np.testing.assert_allclose(body.truth.objects_in_robot_frame()[0, :2], BASKET_XY, atol=0.075)
    np.testing.assert_allclose(body.state().joints, REST_POSE, atol=0.05)


# --- Pictures ------------------------------------------------------------------------------------------------
def test_a_picture_is_taken_once_until_time_passes(body: SimBody, skills: Skills) -> None:
    skills.navigate(0.0, 0.0)
    assert skills.picture() is skills.picture()
    first = skills.picture()
    skills.navigate(0.3, 0.0)
    assert skills.picture() is not first
