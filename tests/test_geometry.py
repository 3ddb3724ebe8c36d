from __future__ import annotations

import json
from itertools import pairwise

import mujoco
import numpy as np
import pytest

from relmm.errors import ConfigError, RobotError
from relmm.features import BASKET_XY, GRID, JOINT_NAMES, cell_to_xy
from relmm.geometry import (
    CAMERAS,
    FOREARM,
    JOINT_LIMITS,
    TOOL_LENGTH,
    UPPER_ARM,
    CameraGeometry,
    arm_forward,
    arm_inverse,
    camera_geometry,
    camera_info,
    moved,
)
from relmm.sim.model import ROBOT, build_model
from relmm.sim.rooms import make_room

DOWN = np.pi / 2
HEIGHTS = [0.014, 0.05, 0.10, 0.15]  # m; from the grasp to above it
GRASPS = [(*cell_to_xy(cell), z) for z in HEIGHTS for cell in range(GRID**2)]


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    return build_model(make_room("no_obstacles", num_objects=1), camera_geometry("paper"))


# --- Arm -----------------------------------------------------------------------------------------------------
def test_forward_undoes_inverse_at_every_cell() -> None:
    reached = [arm_forward(arm_inverse(*point, DOWN))[3] for point in GRASPS]
    np.testing.assert_allclose(reached, GRASPS, atol=1e-9)


def test_tool_points_straight_down_at_every_cell() -> None:
    for point in GRASPS:
        wrist, tool = arm_forward(arm_inverse(*point, DOWN))[2:]
        np.testing.assert_allclose(tool - wrist, [0, 0, -TOOL_LENGTH], atol=1e-9)


def test_joints_stay_within_limits_at_every_cell() -> None:
    joints = np.array([arm_inverse(*point, DOWN) for point in GRASPS])
    assert np.all(joints >= JOINT_LIMITS[:, 0])
    assert np.all(joints <= JOINT_LIMITS[:, 1])


def test_links_keep_their_lengths() -> None:
    rng = np.random.default_rng(0)
    for joints in rng.uniform(JOINT_LIMITS[:, 0], JOINT_LIMITS[:, 1], (50, 5)):
        lengths = [np.linalg.norm(b - a) for a, b in pairwise(arm_forward(joints))]
        np.testing.assert_allclose(lengths, [UPPER_ARM, FOREARM, TOOL_LENGTH])


def test_mujocos_own_kinematics_agree_at_every_cell(model: mujoco.MjModel) -> None:
    data = mujoco.MjData(model)
    mujoco.mj_resetData(model, data)
    names = [ROBOT + name.removesuffix(".pos") for name in JOINT_NAMES]
    addresses = [model.joint(name).qposadr[0] for name in names]
    base = model.joint(ROBOT + "base").qposadr[0]
    data.qpos[base : base + 7] = [0, 0, 0, 1, 0, 0, 0]
    for point in GRASPS:
        data.qpos[addresses] = arm_inverse(*point, DOWN)
        mujoco.mj_kinematics(model, data)
        np.testing.assert_allclose(data.site(ROBOT + "tool").xpos, point, atol=1e-4)


def test_mujocos_own_kinematics_agree_anywhere(model: mujoco.MjModel) -> None:
    data = mujoco.MjData(model)
    addresses = [model.joint(ROBOT + name.removesuffix(".pos")).qposadr[0] for name in JOINT_NAMES]
    rng = np.random.default_rng(0)
    for joints in rng.uniform(JOINT_LIMITS[:, 0], JOINT_LIMITS[:, 1], (50, 5)):
        data.qpos[addresses] = joints
        mujoco.mj_kinematics(model, data)
        bodies = [data.body(ROBOT + name).xpos for name in ("shoulder", "elbow", "wrist_angle")]
        np.testing.assert_allclose(
            [*bodies, data.site(ROBOT + "tool").xpos] - data.body(ROBOT + "base").xpos, arm_forward(joints), atol=1e-4
        )


def test_joint_limits_are_those_of_the_model(model: mujoco.MjModel) -> None:
    ranges = [model.joint(ROBOT + name.removesuffix(".pos")).range for name in JOINT_NAMES]
    np.testing.assert_allclose(ranges, JOINT_LIMITS)


def test_arm_reaches_over_and_into_the_basket() -> None:
    for z in (0.20, 0.30):
        np.testing.assert_allclose(arm_forward(arm_inverse(*BASKET_XY, z, DOWN))[3], [*BASKET_XY, z], atol=1e-9)


@pytest.mark.parametrize("point", [(1.0, 0.0, 0.1), (0.4, 0.0, 2.0), (-0.6, 0.0, 0.1), (0.4, 1.0, 0.0)])
def test_points_out_of_reach_are_refused(point: tuple[float, float, float]) -> None:
    with pytest.raises(RobotError, match="does not reach"):
        arm_inverse(*point, DOWN)


def test_points_behind_a_joint_limit_are_refused() -> None:
    with pytest.raises(RobotError, match="joint limit"):
        arm_inverse(0.15, 0.0, 0.05, 0.0)


# --- Camera --------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("name", CAMERAS)
def test_floor_points_survive_the_way_to_pixels_and_back(name: str) -> None:
    floor = np.stack(np.meshgrid(np.linspace(0.3, 1.5, 9), np.linspace(-0.5, 0.5, 9)), axis=-1)
    pixels = CAMERAS[name].project(np.concatenate([floor, np.zeros((9, 9, 1))], axis=-1))
    np.testing.assert_allclose(CAMERAS[name].pixel_to_floor(pixels), floor, atol=1e-9)


@pytest.mark.parametrize("name", CAMERAS)
def test_depth_to_points_undoes_projection(name: str) -> None:
    camera = CAMERAS[name]
    depth = np.random.default_rng(0).uniform(300, 2000, camera.size[::-1])
    points = camera.depth_to_points(depth)
    column, row = np.moveaxis(camera.project(points), -1, 0)
    np.testing.assert_allclose(column, np.broadcast_to(np.arange(camera.size[0]), column.shape), atol=1e-6)
    np.testing.assert_allclose(row, np.broadcast_to(np.arange(camera.size[1])[:, None], row.shape), atol=1e-6)


@pytest.mark.parametrize("name", CAMERAS)
def test_grasp_area_is_in_view(name: str) -> None:
    xy = cell_to_xy(np.arange(GRID**2))
    pixels = CAMERAS[name].project(np.column_stack([xy, np.zeros(GRID**2)]))
    assert pixels.min() >= 0
    assert pixels.max() <= CAMERAS[name].size[0] - 1


def test_middle_of_the_papers_picture_looks_where_the_authors_camera_looks() -> None:
    camera = CAMERAS["paper"]
    column, row = camera.project(np.array([0.5, 0.0, 0.2]))
    assert (column, row) == pytest.approx((49.5, 49.5), abs=0.2)


def test_left_of_the_robot_is_left_in_the_picture() -> None:
    left, right = CAMERAS["paper"].project(np.array([[0.5, 0.1, 0.0], [0.5, -0.1, 0.0]]))
    assert left[0] < right[0]


def test_above_the_horizon_there_is_no_floor() -> None:
    camera = CameraGeometry(position=(0.0, 0.0, 0.5), pitch=0.0, fov=(60.0, 60.0))
    assert np.isnan(camera.pixel_to_floor(np.array([50.0, 10.0]))).all()
    assert np.isfinite(camera.pixel_to_floor(np.array([50.0, 90.0]))).all()


def test_behind_the_camera_there_are_no_pixels() -> None:
    assert np.isnan(CAMERAS["paper"].project(np.array([-1.0, 0.0, 0.0]))).all()


def test_unknown_camera_is_refused_with_the_known_ones() -> None:
    with pytest.raises(ConfigError, match=r"Unknown camera 'fisheye': choose one of paper, d435\."):
        camera_geometry("fisheye")


@pytest.mark.parametrize("name", CAMERAS)
def test_what_a_dataset_says_about_a_camera_is_the_camera(name: str) -> None:
    info = json.loads(json.dumps(camera_info(name)))
    assert info == camera_info(name)
    assert info.pop("name") == name
    position, fov = tuple(info.pop("position")), tuple(info.pop("fov"))
    assert CameraGeometry(position=position, fov=fov, **info) == CAMERAS[name]


# --- Odometry ------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("pose", "motion", "expected"),
    [
        ((0, 0, 0), (0.3, 0.1, 0.2), (0.3, 0.1, 0.2)),
        ((1, 2, np.pi / 2), (0.3, 0.1, 0.2), (0.9, 2.3, np.pi / 2 + 0.2)),
        ((1, 2, np.pi), (0.3, 0.1, -0.2), (0.7, 1.9, np.pi - 0.2)),
        ((1, 2, -6 * np.pi), (0.3, 0.1, -1), (1.3, 2.1, -6 * np.pi - 1)),  # a heading is not wrapped
    ],
)
def test_a_motion_is_seen_from_where_it_begins(pose, motion, expected) -> None:
    assert moved(np.array(pose, float), np.array(motion, float)) == pytest.approx(expected)


def test_motions_compose_in_any_grouping() -> None:
    a, b, c = np.random.default_rng(0).uniform(-2, 2, (3, 3))
    np.testing.assert_allclose(moved(moved(a, b), c), moved(a, moved(b, c)))
    back = np.array([-(np.cos(a[2]) * a[0] + np.sin(a[2]) * a[1]), np.sin(a[2]) * a[0] - np.cos(a[2]) * a[1], -a[2]])
    np.testing.assert_allclose(moved(a, back), 0, atol=1e-12)
