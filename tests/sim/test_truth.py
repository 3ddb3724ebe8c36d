from __future__ import annotations

import logging
from collections.abc import Iterator
from pathlib import Path

import mujoco
import numpy as np
import pytest

from relmm.errors import PhysicsError
from relmm.features import BASKET_XY
from relmm.geometry import camera_geometry
from relmm.sim.body import SimBody
from relmm.sim.rooms import OBJECT_PREFIX, make_room


@pytest.fixture(scope="module")
def shared_body() -> Iterator[SimBody]:
    body = SimBody(make_room("no_obstacles", num_objects=3), camera_geometry("paper"))
    yield body
    body.close()


@pytest.fixture
def body(shared_body: SimBody) -> SimBody:
    shared_body.reset(np.random.default_rng(1))
    return shared_body


def put(body: SimBody, joint: str, *pose: float) -> None:
    """Move a free joint without physics."""
    start = body.model.joint(joint).qposadr[0]
    body.data.qpos[start : start + len(pose)] = pose
    mujoco.mj_forward(body.model, body.data)


def to_room(body: SimBody, x: float, y: float) -> tuple[float, float]:
    robot_x, robot_y, heading = body.truth.robot()
    cos, sin = np.cos(heading), np.sin(heading)
    return robot_x + cos * x - sin * y, robot_y + sin * x + cos * y


def test_after_a_reset_everything_is_in_its_place(body: SimBody) -> None:
    assert body.truth.robot()[:2] == pytest.approx((0, 0), abs=0.005)
    assert not body.truth.held()
    assert body.truth.in_basket().size == body.truth.lost().size == 0
    assert np.all(np.linalg.norm(body.truth.objects()[:, :2], axis=1) > 0.49)


def test_robot_frame_has_x_forward_and_y_left(body: SimBody) -> None:
    put(body, f"{OBJECT_PREFIX}01", *to_room(body, 0.4, 0.1), 0.015)
    np.testing.assert_allclose(body.truth.objects_in_robot_frame()[1, :2], [0.4, 0.1], atol=1e-3)


def test_an_object_in_the_basket_is_counted(body: SimBody) -> None:
    put(body, f"{OBJECT_PREFIX}02", *to_room(body, *BASKET_XY), 0.2)
    body.wait(0.5)
    assert body.truth.in_basket().tolist() == [2]


def test_an_object_under_the_basket_is_not_counted(body: SimBody) -> None:
    put(body, f"{OBJECT_PREFIX}02", *to_room(body, *BASKET_XY), 0.03)
    assert body.truth.in_basket().size == 0


def test_an_object_between_the_pads_counts_as_held_only_above_the_floor(body: SimBody) -> None:
    tool = body.data.site("locobot/tool").xpos.copy()
    put(body, f"{OBJECT_PREFIX}00", *tool)
    assert body.truth.held()
    put(body, f"{OBJECT_PREFIX}00", *tool[:2], 0.015)
    assert not body.truth.held()


@pytest.mark.parametrize("place", [(2.0, 0.0, 0.015), (0.9, -1.6, 0.015), (0.5, 0.5, -0.1)])
def test_an_object_outside_is_logged_once_and_counted(
    body: SimBody, place: tuple[float, float, float], caplog: pytest.LogCaptureFixture
) -> None:
    put(body, f"{OBJECT_PREFIX}01", *place)
    assert body.truth.lost().tolist() == [1]
    with caplog.at_level(logging.WARNING):
        body.truth.check()
        body.truth.check()
    assert [r.getMessage().split(" at ")[0] for r in caplog.records] == [
        "Object 1 left the room through a wall or the floor"
    ]


def test_after_a_reset_lost_objects_are_back_and_logged_anew(body: SimBody, caplog: pytest.LogCaptureFixture) -> None:
    for _ in range(2):
        put(body, f"{OBJECT_PREFIX}01", 2.0, 0.0, 0.015)
        body.truth.check()
        body.reset(np.random.default_rng(1))
        assert body.truth.lost().size == 0
    assert len(caplog.records) == 2


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_numbers_that_are_not_finite_end_the_simulation(body: SimBody, value: float) -> None:
    body.data.qvel[3] = value
    with pytest.raises(PhysicsError, match="became unstable"):
        body.truth.check()


def test_waiting_notices_numbers_that_are_not_finite(
    body: SimBody, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)  # MuJoCo writes its warnings into the working directory
    body.data.qpos[0] = np.nan
    with pytest.raises(PhysicsError, match="became unstable"):
        body.wait(0.02)


def test_a_robot_outside_of_the_room_ends_the_simulation(body: SimBody) -> None:
    put(body, "locobot/base", 1.7, 0.0)
    with pytest.raises(PhysicsError, match=r"left the room at \(1\.70, 0\.00\) m"):
        body.truth.check()


def test_a_robot_that_has_tipped_over_ends_the_simulation(body: SimBody) -> None:
    put(body, "locobot/base", 0.0, 0.0, 0.3, np.cos(0.4), np.sin(0.4), 0.0, 0.0)
    with pytest.raises(PhysicsError, match="tipped over"):
        body.truth.check()
