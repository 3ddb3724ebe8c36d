from __future__ import annotations

from collections.abc import Iterator

import mujoco
import numpy as np
import pytest

from relmm.features import BASKET_XY, GRID, MAX_THETA_VEL, MAX_X_VEL, cell_to_xy, in_grasp_area, xy_to_cell
from relmm.geometry import CAMERAS, JOINT_LIMITS, camera_geometry
from relmm.robot.body import BUMPER_CENTRE, BUMPER_LEFT, BUMPER_RIGHT, MAX_OPENING
from relmm.robot.skills import PRESENT_POSE, REST_POSE, Skills
from relmm.sim.body import SimBody
from relmm.sim.rooms import make_room

TICK_S = 0.02
ROBOT_RADIUS = 0.178  # m
# Twice what 200 skills have shown: the tip of the arm does 1 m/s, an object that slips out of the fingers 1.5.
MAX_SPEED = 3.0  # m/s


@pytest.fixture(scope="module")
def shared_body() -> Iterator[SimBody]:
    body = SimBody(make_room("no_obstacles", num_objects=3), camera_geometry("paper"))
    yield body
    body.close()


@pytest.fixture
def body(shared_body: SimBody) -> SimBody:
    shared_body.reset(np.random.default_rng(0))
    return shared_body


def put_robot(body: SimBody, x: float, y: float, heading: float) -> None:
    """Move the robot without physics."""
    start = body.model.joint("locobot/base").qposadr[0]
    body.data.qpos[start : start + 2] = x, y
    body.data.qpos[start + 3 : start + 7] = np.cos(heading / 2), 0, 0, np.sin(heading / 2)
    mujoco.mj_forward(body.model, body.data)


def live(body: SimBody, rng: np.random.Generator, count: int) -> Iterator[None]:
    """Run random skills, and let the caller look after each: drives, hopeful and hopeless grasps, placements."""
    skills = Skills(body, rng)
    for _ in range(count):
        in_reach = [xy for *xy, z in body.truth.objects_in_robot_frame() if in_grasp_area(*xy) and z < 0.05]
        if skills.holding and rng.random() < 0.3:
            skills.place_in_basket() if rng.random() < 0.5 else skills.place(*cell_to_xy(int(rng.integers(GRID**2))))
        elif not skills.holding and (in_reach or rng.random() < 0.15):
            cell = xy_to_cell(*in_reach[0]) if in_reach else int(rng.integers(GRID**2))
            skills.grasp(*cell_to_xy(cell))
        else:
            skills.navigate(rng.uniform(0, MAX_X_VEL), rng.uniform(-MAX_THETA_VEL, MAX_THETA_VEL))
        yield


# --- Time and determinism ------------------------------------------------------------------------------------
def test_time_passes_only_while_waiting(body: SimBody) -> None:
    start = body.state().time
    body.drive(0.4, 0.0)
    body.move_arm(PRESENT_POSE, 0.5)
    body.capture()
    assert body.state().time == start
    body.wait(0.5)
    assert body.state().time == pytest.approx(start + 0.5)


@pytest.mark.parametrize("room", ["obstacles", "diverse"])
def test_the_same_seed_lives_the_same_life(room: str) -> None:
    bodies = [SimBody(make_room(room), camera_geometry("paper")) for _ in range(2)]
    for body in bodies:
        body.reset(np.random.default_rng(5))
    for _ in zip(*(live(body, np.random.default_rng(6), 30) for body in bodies), strict=True):
        np.testing.assert_array_equal(bodies[0].data.qpos, bodies[1].data.qpos)
        for one, other in zip(bodies[0].capture(), bodies[1].capture(), strict=True):
            np.testing.assert_array_equal(one, other)
    for body in bodies:
        body.close()


def test_a_reset_leaves_nothing_of_the_former_life() -> None:
    used, fresh = (SimBody(make_room("diverse"), camera_geometry("paper")) for _ in range(2))
    used.reset(np.random.default_rng(1))
    for _ in live(used, np.random.default_rng(2), 60):
        pass
    for body in (used, fresh):
        body.reset(np.random.default_rng(3))
        for _ in live(body, np.random.default_rng(4), 20):
            pass
    np.testing.assert_array_equal(used.data.qpos, fresh.data.qpos)
    np.testing.assert_array_equal(used.capture()[0], fresh.capture()[0])
    used.close()
    fresh.close()


def test_another_seed_scatters_differently(body: SimBody) -> None:
    before, heading = body.truth.objects(), body.truth.robot()[2]
    body.reset(np.random.default_rng(1))
    assert np.abs(body.truth.objects() - before).max() > 0.1
    assert abs(body.truth.robot()[2] - heading) > 0.01


def test_nothing_is_teleported(monkeypatch: pytest.MonkeyPatch) -> None:
    body = SimBody(make_room("diverse"), camera_geometry("paper"))
    body.reset(np.random.default_rng(7))
    joints = [body.model.body(i).jntadr[0] for i in body.truth.object_ids]
    places = body.model.jnt_qposadr[joints][:, None] + np.arange(3)
    jumps: list[float] = []
    last = body.data.qpos[places]

    def step(model: mujoco.MjModel, data: mujoco.MjData, nstep: int = 1) -> None:
        nonlocal last
        original(model, data, nstep)
        jumps.append(np.linalg.norm(data.qpos[places] - last, axis=1).max())
        last = data.qpos[places]

    original = mujoco.mj_step
    monkeypatch.setattr(mujoco, "mj_step", step)
    collected = 0
    for _ in live(body, np.random.default_rng(8), 200):
        collected = max(collected, len(body.truth.in_basket()))
    assert collected >= 1, "the robot must have lived through everything, carrying in the basket included"
    assert max(jumps) < MAX_SPEED * TICK_S
    body.close()


# --- Base ----------------------------------------------------------------------------------------------------
def test_driving_moves_the_robot_as_its_encoders_say(body: SimBody) -> None:
    x, y, heading = body.truth.robot()
    body.drive(0.4, 0.0)
    body.wait(1.0)
    new_x, new_y, new_heading = body.truth.robot()
    assert np.hypot(new_x - x, new_y - y) == pytest.approx(body.state().travelled, abs=0.01)
    assert body.state().travelled == pytest.approx(0.4, abs=0.05)
    assert new_heading == pytest.approx(heading, abs=0.02)


@pytest.mark.parametrize("theta_vel", [-90.0, 90.0])
def test_turning_is_positive_to_the_left(body: SimBody, theta_vel: float) -> None:
    heading = body.truth.robot()[2]
    body.drive(0.0, theta_vel)
    body.wait(1.0)
    turned = np.degrees((body.truth.robot()[2] - heading + np.pi) % (2 * np.pi) - np.pi)
    assert turned == pytest.approx(body.state().heading, abs=4.0)
    assert turned == pytest.approx(theta_vel, abs=12.0)


@pytest.mark.parametrize("command", ["stop", "close"])
def test_wheels_stand_still_after(command: str, body: SimBody) -> None:
    body.drive(0.44, 0.0)
    body.wait(0.4)
    getattr(body, command)()
    body.wait(0.3)
    before = body.truth.robot()
    body.wait(1.0)
    assert body.truth.robot() == pytest.approx(before, abs=0.002)


def test_acceleration_is_limited(body: SimBody) -> None:
    body.drive(0.44, 0.0)
    body.wait(TICK_S)
    assert body.state().travelled < 0.44 * TICK_S / 2


def test_a_wall_stops_the_robot(body: SimBody) -> None:
    put_robot(body, 1.5 - ROBOT_RADIUS - 0.1, 0.0, 0.0)
    body.drive(MAX_X_VEL, 0.0)
    for _ in range(100):
        body.wait(TICK_S)
        assert body.truth.robot()[0] < 1.5 - ROBOT_RADIUS + 0.005
    assert body.truth.robot()[0] > 1.5 - ROBOT_RADIUS - 0.02


@pytest.mark.parametrize(
    ("heading", "bit"), [(0.0, BUMPER_CENTRE), (50.0, BUMPER_RIGHT), (-50.0, BUMPER_LEFT), (10.0, BUMPER_CENTRE)]
)
def test_bumper_says_which_side_was_hit(body: SimBody, heading: float, bit: int) -> None:
    put_robot(body, 1.5 - ROBOT_RADIUS - 0.03, 0.0, np.radians(heading))
    body.drive(0.3, 0.0)
    pressed = 0
    for _ in range(10):
        body.wait(0.04)
        pressed |= body.state().bumper
    assert pressed == bit


def test_bumper_is_silent_away_from_walls_and_at_the_back(body: SimBody) -> None:
    body.drive(0.3, 0.0)
    body.wait(0.5)
    assert body.state().bumper == 0
    put_robot(body, 1.5 - ROBOT_RADIUS - 0.03, 0.0, np.pi)
    body.drive(-0.3, 0.0)
    body.wait(1.0)
    assert body.state().bumper == 0


def test_balls_do_not_press_the_bumper(body: SimBody) -> None:
    x, y, heading = body.truth.robot()
    start = body.model.joint("object_00").qposadr[0]
    body.data.qpos[start : start + 2] = x + 0.25 * np.cos(heading), y + 0.25 * np.sin(heading)
    mujoco.mj_forward(body.model, body.data)
    before = body.truth.objects()[0]
    body.drive(0.4, 0.0)
    body.wait(0.6)
    assert np.linalg.norm(body.truth.objects()[0] - before) > 0.05, "the base pushes it"
    assert body.state().bumper == 0


# --- Arm and gripper -----------------------------------------------------------------------------------------
def test_arm_arrives_where_it_is_sent(body: SimBody) -> None:
    body.move_arm(PRESENT_POSE, 0.7)
    body.wait(1.0)
    np.testing.assert_allclose(body.state().joints, PRESENT_POSE, atol=0.03)
    np.testing.assert_allclose(body.state().joint_goal, PRESENT_POSE)


def test_arm_moves_smoothly_to_its_goal(body: SimBody) -> None:
    body.move_arm(PRESENT_POSE, 0.6)
    goals = []
    for _ in range(30):
        body.wait(TICK_S)
        goals.append(body.state().joint_goal)
    steps = np.abs(np.diff([REST_POSE, *goals], axis=0)).max(axis=1)
    assert steps.max() < 2 * np.abs(PRESENT_POSE - REST_POSE).max() / 30
    assert steps[0] < steps.max() / 3


def test_goals_beyond_the_joint_limits_are_clipped(body: SimBody) -> None:
    body.move_arm(np.array([9.0, -9.0, 9.0, -9.0, 9.0]), 0.1)
    body.wait(0.2)
    expected = JOINT_LIMITS[np.arange(5), [1, 0, 1, 0, 1]]
    np.testing.assert_allclose(body.state().joint_goal, expected)


def test_gripper_opens_and_closes(body: SimBody) -> None:
    body.set_gripper(-0.005)
    body.wait(0.5)
    assert body.state().gripper == pytest.approx(0.0, abs=0.003)
    body.set_gripper(1.0)
    body.wait(0.5)
    assert body.state().gripper == pytest.approx(MAX_OPENING, abs=0.002)


def test_stop_holds_the_arm(body: SimBody) -> None:
    body.move_arm(PRESENT_POSE, 1.0)
    body.wait(0.5)
    body.stop()
    body.wait(0.2)
    before = body.state().joints
    body.wait(0.5)
    np.testing.assert_allclose(body.state().joints, before, atol=0.02)
    assert np.abs(before - PRESENT_POSE).max() > 0.1


# --- Basket --------------------------------------------------------------------------------------------------
def test_the_basket_keeps_its_contents_on_a_wild_ride(body: SimBody) -> None:
    x, y, heading = body.truth.robot()
    for index in range(3):
        cos, sin, side = np.cos(heading), np.sin(heading), BASKET_XY[0] + (index - 1) * 0.035
        start = body.model.joint(f"object_{index:02d}").qposadr[0]
        place = x + cos * side - sin * BASKET_XY[1], y + sin * side + cos * BASKET_XY[1], 0.2
        body.data.qpos[start : start + 3] = place
    mujoco.mj_forward(body.model, body.data)
    body.wait(0.6)
    assert len(body.truth.in_basket()) == 3
    rng = np.random.default_rng(0)
    body.drive(0.0, 0.0)
    before = body.truth.objects_in_robot_frame()
    for _ in range(20):
        body.drive(rng.uniform(-0.2, 0.2), rng.uniform(-MAX_THETA_VEL, MAX_THETA_VEL))
        body.wait(0.2)
    np.testing.assert_allclose(body.truth.objects_in_robot_frame(), before, atol=0.015)


def test_the_named_cameras_see_different_things() -> None:
    pictures = []
    for camera in CAMERAS.values():
        body = SimBody(make_room("no_obstacles", num_objects=1), camera)
        body.reset(np.random.default_rng(0))
        pictures.append(body.capture()[0].astype(int))
        body.close()
    assert np.abs(pictures[0] - pictures[1]).mean() > 1
