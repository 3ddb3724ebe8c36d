from __future__ import annotations

import cv2
import numpy as np
import pytest

from relmm.errors import ConfigError
from relmm.features import ACTION_NAMES, MAX_THETA_VEL, MAX_X_VEL, Skill, cell_to_xy, xy_to_cell
from relmm.geometry import CAMERAS, CameraGeometry
from relmm.policies.scripted.vision import detect_objects
from relmm.sim.env import RelmmRoomEnv
from relmm.sim.rooms import set_objects

GREEN, YELLOW = (51, 153, 51), (230, 190, 40)
RADIUS = 0.015  # m


def with_balls(
    floor: np.ndarray, *points: tuple[float, float], camera: CameraGeometry = CAMERAS["paper"], color=GREEN
) -> np.ndarray:
    """Draws balls on the floor: the pixels whose rays pass within a radius of a ball's centre."""
    picture = floor.copy()
    rays = camera.rays(np.stack(np.meshgrid(np.arange(100), np.arange(100)), axis=-1))
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    for point in points:
        centre = np.array([*point, RADIUS]) - np.array(camera.position)
        picture[np.linalg.norm(np.cross(rays, centre), axis=-1) < RADIUS] = color
    return picture


def wooden_pictures(camera: str) -> list[np.ndarray]:
    """The empty room without obstacles, all round from its middle."""
    env = RelmmRoomEnv(num_objects=1, camera=camera)
    env.reset(seed=0)
    body = env.robot.body
    set_objects(body.model, body.data, np.array([[-10.0, 0.0, 0.0]]))
    pictures = []
    for _ in range(14):
        body.wait(0.02)
        pictures.append(body.capture()[0])
        body.drive(0.0, MAX_THETA_VEL)
        body.wait(0.24)
    env.close()
    return pictures


# --- Detection -----------------------------------------------------------------------------------------------
@pytest.mark.parametrize("name", CAMERAS)
@pytest.mark.parametrize("color", [GREEN, YELLOW])
@pytest.mark.parametrize(
    ("point", "error"),
    [((0.38, 0.0), 0.01), ((0.33, 0.07), 0.01), ((0.45, -0.06), 0.01), ((0.6, 0.2), 0.015), ((0.9, -0.25), 0.025)],
)
def test_a_ball_is_found_where_it_lies(name: str, color, point: tuple[float, float], error: float, empty) -> None:
    found = detect_objects(with_balls(empty, point, camera=CAMERAS[name], color=color), CAMERAS[name])
    assert found.shape == (1, 2)
    assert np.linalg.norm(found[0] - point) < error


@pytest.mark.parametrize("point", [(1.5, 0.0), (1.45, 0.5), (1.4, -0.4)])
def test_a_far_ball_is_found_a_little_less_exactly(point: tuple[float, float], empty) -> None:
    found = detect_objects(with_balls(empty, point), CAMERAS["paper"])
    assert found.shape == (1, 2)
    assert np.linalg.norm(found[0] - point) < 0.05


def test_objects_come_closest_first(empty) -> None:
    found = detect_objects(with_balls(empty, (1.0, 0.2), (0.4, 0.0), (0.7, -0.2)), CAMERAS["paper"])
    assert np.linalg.norm(found - [(0.4, 0.0), (0.7, -0.2), (1.0, 0.2)], axis=1).max() < 0.03


@pytest.mark.parametrize("name", CAMERAS)
def test_an_empty_room_is_empty(name: str) -> None:
    assert sum(len(detect_objects(picture, CAMERAS[name])) for picture in wooden_pictures(name)) == 0


def test_what_is_no_object_is_not_taken_for_one(empty) -> None:
    camera = CAMERAS["paper"]
    scene = empty.copy()
    scene[:40, 60:] = (160, 150, 150)  # a wall
    cv2.line(scene, (5, 99), (50, 45), (150, 130, 110), 1)  # a joint
    cv2.rectangle(scene, (60, 60), (80, 80), (90, 60, 90), cv2.FILLED)  # a box
    cv2.circle(scene, (30, 99), 4, GREEN, cv2.FILLED)  # cut off
    assert len(detect_objects(scene, camera)) == 0
    pattern = [(x, y) for x in (0.6, 0.72, 0.84) for y in (-0.12, 0.0, 0.12)]
    assert len(detect_objects(with_balls(empty, *pattern), camera)) == 0


# --- Decisions -----------------------------------------------------------------------------------------------
@pytest.mark.parametrize("name", CAMERAS)
def test_grasps_what_lies_in_the_graspable_area(name: str, make_controller, act, empty) -> None:
    policy = make_controller("relmm_scripted", camera=name)
    action = act(policy, with_balls(empty, (0.36, 0.03), (0.44, 0.0), camera=CAMERAS[name]))
    assert action["skill.pos"] == Skill.GRASP
    x, y = action["skill_x.pos"], action["skill_y.pos"]
    assert np.hypot(x - 0.36, y - 0.03) < 0.012
    assert np.allclose(cell_to_xy(xy_to_cell(x, y)), (x, y))


@pytest.mark.parametrize("num_grasp", [1, 3])
def test_attempts_in_a_row_are_limited(num_grasp: int, make_controller, act, empty) -> None:
    """Each attempt pushes the ball to another place."""
    policy = make_controller("relmm_scripted", num_grasp=num_grasp)
    places = [(0.33, -0.06), (0.36, 0.05), (0.40, -0.05), (0.43, 0.05)]
    skills = [act(policy, with_balls(empty, place))["skill.pos"] for place in places[: num_grasp + 1]]
    assert skills == [Skill.GRASP] * num_grasp + [Skill.NAVIGATE]


def test_does_not_grasp_twice_where_nothing_could_be_grasped(make_controller, act, empty) -> None:
    policy = make_controller("relmm_scripted", num_grasp=5)
    picture = with_balls(empty, (0.40, 0.0))
    assert act(policy, picture)["skill.pos"] == Skill.GRASP
    assert act(policy, picture)["skill.pos"] == Skill.NAVIGATE


@pytest.mark.parametrize("name", CAMERAS)
@pytest.mark.parametrize("side", [-1, 1])
def test_drives_towards_the_closest_object(name: str, side: int, make_controller, act, empty) -> None:
    policy = make_controller("relmm_scripted", camera=name)
    action = act(policy, with_balls(empty, (0.8, 0.1 * side), (1.0, -0.3 * side), camera=CAMERAS[name]))
    assert action["skill.pos"] == Skill.NAVIGATE
    assert action["x.vel"] == pytest.approx(MAX_X_VEL)
    assert action["theta.vel"] == pytest.approx(side * np.degrees(np.arctan2(0.1, 0.8)) / 0.24, abs=4)


def test_turns_on_the_spot_to_what_lies_at_the_side(make_controller, act, empty) -> None:
    action = act(make_controller("relmm_scripted"), with_balls(empty, (0.36, 0.24)))
    assert action["skill.pos"] == Skill.NAVIGATE
    assert action["x.vel"] == 0
    assert action["theta.vel"] == pytest.approx(MAX_THETA_VEL)


def test_stays_with_its_target_when_another_becomes_a_little_closer(make_controller, act, empty) -> None:
    policy = make_controller("relmm_scripted")
    first = act(policy, with_balls(empty, (0.80, 0.2), (0.86, -0.2)))
    assert first["theta.vel"] > 0
    assert act(policy, with_balls(empty, (0.76, 0.15), (0.72, -0.2)))["theta.vel"] > 0


def test_goes_straight_on_after_the_robot_has_turned_away(make_controller, act, empty) -> None:
    policy = make_controller("relmm_scripted")
    act(policy, with_balls(empty, (0.7, 0.0)))
    action = act(policy, with_balls(empty, (0.5, 0.25)))
    assert (action["x.vel"], action["theta.vel"]) == pytest.approx((MAX_X_VEL, 0))


def test_searches_all_round_and_then_elsewhere(make_controller, act, empty) -> None:
    policy = make_controller("relmm_scripted")
    actions = [act(policy, empty) for _ in range(40)]
    turns = [action["theta.vel"] for action in actions]
    assert set(np.abs(turns[:12])) == {MAX_THETA_VEL}
    assert len(set(turns[:12])) == 1
    assert any(action["x.vel"] == pytest.approx(MAX_X_VEL) for action in actions)


def test_an_unknown_camera_is_refused(make_controller) -> None:
    with pytest.raises(ConfigError, match="Unknown camera 'webcam': choose one of paper, d435"):
        make_controller("relmm_scripted", camera="webcam")


# --- In the room ---------------------------------------------------------------------------------------------
@pytest.mark.parametrize("camera", CAMERAS)
def test_cleans_a_part_of_the_room(camera: str, make_controller, act) -> None:
    env, policy = RelmmRoomEnv(camera=camera, navigation_steps=40), make_controller("relmm_scripted", camera=camera)
    observation, info = env.reset(seed=1000)
    ended = False
    while not ended:
        held = (0,) if env.robot.skills.holding else ()
        action = act(policy, observation["pixels"]["front"], holding=held)
        observation, _, done, truncated, info = env.step(np.array([action[name] for name in ACTION_NAMES], np.float32))
        ended = done or truncated
    env.close()
    assert info["objects_collected"] >= 3
