"""The camera through LeRobot's RealSense class, with a fake of librealsense behind it."""

from __future__ import annotations

import numpy as np
import pytest

from relmm.errors import RobotError
from relmm.geometry import CAMERAS, CameraGeometry
from relmm.robot.hardware.d435 import D435, view_maps

VIEW = CAMERAS["d435"]


def lens(fake) -> np.ndarray:
    return np.array([fake.INTRINSICS.fx, fake.INTRINSICS.fy, fake.INTRINSICS.ppx, fake.INTRINSICS.ppy])


def see_floor(fake, pitch: float, spot: tuple[float, float] | None = None) -> tuple[np.ndarray, np.ndarray]:
    """What a real camera at `VIEW`'s place sees of an empty floor, with a red spot of 2 cm on it."""
    columns, rows = np.meshgrid(np.arange(640), np.arange(480))
    fx, fy, cx, cy = lens(fake)
    axes = CameraGeometry(VIEW.position, pitch, (60.0, 60.0)).axes
    rays = np.stack([(columns - cx) / fx, (rows - cy) / fy, np.ones_like(rows)], axis=-1) @ axes
    depth = VIEW.position[2] / -rays[..., 2]
    floor = np.array(VIEW.position) + rays * depth[..., None]
    rgb = np.full((480, 640, 3), 200, np.uint8)
    if spot is not None:
        rgb[np.hypot(*(floor[..., :2] - spot).transpose(2, 0, 1)) < 0.01] = (255, 0, 0)
    return rgb, np.rint(depth * 1000).astype(np.uint16)


@pytest.mark.parametrize("pitch", [VIEW.pitch, VIEW.pitch + 2.0, VIEW.pitch - 1.5])
@pytest.mark.parametrize("spot", [(0.40, 0.0), (0.35, 0.06), (0.46, -0.05)])
def test_pictures_are_those_of_the_known_camera(realsense, pitch, spot):
    realsense.source = lambda: see_floor(realsense, pitch, spot)
    camera = D435("auto", VIEW, pitch, latency=0.0)
    try:
        rgb, depth = camera.capture()
    finally:
        camera.close()
    assert rgb.shape == (100, 100, 3)
    assert rgb.dtype == np.uint8
    assert depth.shape == (100, 100)
    assert depth.dtype == np.uint16
    redness = np.clip(rgb[..., 0].astype(float) - rgb[..., 1], 0, None)
    rows, columns = np.mgrid[:100, :100]
    middle = np.array([(redness * columns).sum(), (redness * rows).sum()]) / redness.sum()
    assert VIEW.pixel_to_floor(middle) == pytest.approx(spot, abs=0.003)
    points = VIEW.depth_to_points(depth.astype(float))[depth > 0]
    assert np.abs(points[:, 2]).max() < 0.004, "the floor is flat and at height 0"
    assert (depth > 0).mean() > 0.85


def test_what_the_real_camera_does_not_see_has_no_depth(realsense):
    maps = view_maps(VIEW, VIEW.pitch, lens(realsense))
    seen = maps.depth(np.full((480, 640), 700.0)) > 0
    assert not seen[0].any(), "its field of view is a little smaller than the drawing's"
    assert seen[10:90, 10:90].all()


def test_depth_is_never_a_mean_of_near_and_far(realsense):
    picture = np.where(np.arange(640) % 2, 400.0, 900.0) * np.ones((480, 1))
    depth = view_maps(VIEW, VIEW.pitch, lens(realsense)).depth(picture)
    assert set(np.unique(depth)) <= {0, 400, 900}


def test_depth_is_aligned_with_colour(realsense):
    rgb, depth = see_floor(realsense, VIEW.pitch)
    depth[:, 300:340] = 250  # a post
    rgb[:, 300:340] = (0, 0, 255)
    realsense.source = lambda: (rgb, depth)
    camera = D435("auto", VIEW, VIEW.pitch, latency=0.0)
    try:
        color, distance = camera.capture()
    finally:
        camera.close()
    blue, near = (color[50, :, 0] < 50) & (color[50, :, 2] > 100), distance[50] == 250
    assert abs(int(blue.argmax()) - int(near.argmax())) <= 1


def test_pictures_are_newer_than_the_question(realsense):
    count = iter(range(10**6))

    def number() -> tuple[np.ndarray, np.ndarray]:
        return np.full((480, 640, 3), next(count) % 250, np.uint8), np.full((480, 640), 500, np.uint16)

    realsense.source = number
    camera = D435("auto", VIEW, VIEW.pitch, latency=0.0)
    try:
        numbers = [int(camera.capture()[0][50, 50, 0]) for _ in range(5)]
    finally:
        camera.close()
    assert numbers == sorted(set(numbers))
    assert realsense.started == 0, "the pipeline is stopped"


def capture_often(camera: D435) -> None:
    for _ in range(3):
        camera.capture()


# LeRobot's thread ends with an exception after ten failures.
@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_unplugged_camera_is_one_sentence(realsense):
    realsense.source = lambda: see_floor(realsense, VIEW.pitch)
    camera = D435("auto", VIEW, VIEW.pitch, latency=0.0)

    def gone() -> None:
        raise RuntimeError("No device")

    realsense.source = gone
    try:
        with pytest.raises(RobotError, match="The camera sends no pictures: check its cable"):
            capture_often(camera)
        assert not camera.alive
    finally:
        camera.close()


@pytest.mark.parametrize(("number", "words"), [(0, "0 RealSense .* Plug one"), (2, "2 RealSense .*821212062500, 8212")])
def test_none_or_several_cameras_are_one_sentence(realsense, monkeypatch, number, words):
    monkeypatch.setattr(realsense, "plugged", number)
    with pytest.raises(RobotError, match=words):
        D435("auto", VIEW, VIEW.pitch, latency=0.0)


def test_machine_without_pyrealsense2_is_told_what_to_do(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "pyrealsense2", None)
    with pytest.raises(RobotError, match=r"needs pyrealsense2 .* build librealsense"):
        D435("auto", VIEW, VIEW.pitch, latency=0.0)
