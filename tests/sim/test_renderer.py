from __future__ import annotations

from collections.abc import Iterator

import mujoco
import numpy as np
import pytest

from relmm.geometry import CAMERAS, camera_geometry
from relmm.sim.body import SimBody
from relmm.sim.renderer import Renderer, overview_camera
from relmm.sim.rooms import OBJECT_PREFIX, make_room

FLOOR_POINTS = [(0.35, 0.0), (0.40, 0.08), (0.45, -0.08), (0.6, 0.2), (0.6, -0.2), (0.9, 0.15), (0.95, -0.3)]


@pytest.fixture(scope="module", params=CAMERAS)
def body(request: pytest.FixtureRequest) -> Iterator[SimBody]:
    """One ball in a plain room, the robot looking along x."""
    body = SimBody(make_room("no_obstacles", num_objects=1, floor="plain"), camera_geometry(request.param))
    body.reset(np.random.default_rng(0))
    start = body.model.joint("locobot/base").qposadr[0]
    body.data.qpos[start : start + 7] = [0, 0, 0, 1, 0, 0, 0]
    mujoco.mj_forward(body.model, body.data)
    yield body
    body.close()


def put_ball(body: SimBody, x: float, y: float) -> np.ndarray:
    """Move the ball without physics, and say where its middle is now (m, robot frame)."""
    start = body.model.joint(f"{OBJECT_PREFIX}00").qposadr[0]
    body.data.qpos[start : start + 3] = x, y, 0.015
    mujoco.mj_forward(body.model, body.data)
    return body.truth.objects_in_robot_frame()[0]


@pytest.mark.parametrize("point", FLOOR_POINTS)
def test_a_ball_appears_where_the_projection_says(body: SimBody, point: tuple[float, float]) -> None:
    put_ball(body, -1.2, 0.0)
    without = body.capture()[0].astype(int)
    where = put_ball(body, *point)
    row, column = np.nonzero(np.abs(body.capture()[0] - without).sum(axis=-1) > 40)
    assert row.size >= 3
    assert np.hypot(*(body.camera.project(where) - [column.mean(), row.mean()])) < 1.0


def test_floor_has_the_depth_of_the_closed_form(body: SimBody) -> None:
    put_ball(body, -1.2, 0.0)
    width, height = body.camera.size
    pixels = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1)
    floor = body.camera.pixel_to_floor(pixels)
    seen = (floor[..., 0] > 0.5) & (floor[..., 0] < 1.4) & (np.abs(floor[..., 1]) < 1.0)
    expected = -body.camera.position[2] / body.camera.rays(pixels)[..., 2] * 1000
    assert seen.sum() > 1000
    assert np.abs(body.capture()[1][seen] - expected[seen]).max() <= 3.0


def test_a_wall_is_as_far_away_as_it_stands(body: SimBody) -> None:
    points = body.camera.depth_to_points(body.capture()[1])
    wall = points[np.abs(points[..., 2] - 0.3) < 0.1]
    ahead = wall[np.abs(wall[:, 1]) < 0.4]
    if body.camera is CAMERAS["paper"]:  # the other one looks too steeply to see it from the middle
        assert len(ahead) > 10
    np.testing.assert_allclose(ahead[ahead[:, 0] > 1.0, 0], 1.5, atol=0.01)


def test_pictures_have_the_cameras_size_and_types(body: SimBody) -> None:
    rgb, depth = body.capture()
    assert (rgb.shape, rgb.dtype) == ((100, 100, 3), np.uint8)
    assert (depth.shape, depth.dtype) == ((100, 100), np.uint16)


def test_two_renderers_share_the_context_without_mixing_their_pictures(body: SimBody) -> None:
    before = body.capture()[0]
    other = Renderer(body.model, overview_camera(body.room.size), (160, 120))
    overview = other.render(body.data)[0]
    assert overview.shape == (120, 160, 3)
    assert overview.std() > 5
    np.testing.assert_array_equal(body.capture()[0], before)
    other.close()
    np.testing.assert_array_equal(body.capture()[0], before)


def test_the_picture_is_upright(body: SimBody) -> None:
    depth = body.capture()[1].astype(float)
    assert depth[:10, 40:60].mean() > depth[60:70, 40:60].mean() + 200  # mm; far things are above near ones
