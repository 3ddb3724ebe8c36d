"""The RealSense D435 through LeRobot's camera: colour and aligned depth, seen as through the camera of a room."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from lerobot.cameras.realsense import RealSenseCamera, RealSenseCameraConfig
from numpy.typing import NDArray

from relmm.errors import RobotError
from relmm.features import FloatArray
from relmm.geometry import CameraGeometry
from relmm.robot.hardware import clock

WIDTH, HEIGHT, FPS = 640, 480, 30
_SUPERSAMPLING = 4  # a picture of 100x100 is averaged from one four times as large
_NO_MAP = np.empty(0, np.float32)  # the other map holds columns and rows
_POLL_S, _LOST_S = 0.005, 2.0
NO_PICTURES = "The camera sends no pictures: check its cable, and that it is plugged into USB 3."


class AlignedRealSense(RealSenseCamera):
    """LeRobot's camera, with its depth seen from where its colours are seen, and both of the same moment."""

    def connect(self, warmup: bool = True) -> None:
        """As LeRobot's."""
        import pyrealsense2 as rs

        self._align = rs.align(rs.stream.color)
        super().connect(warmup)

    def _read_from_hardware(self) -> Any:
        return self._align.process(super()._read_from_hardware())

    def intrinsics(self) -> FloatArray:
        """Focal lengths and middle of the colour picture, pixels: fx, fy, cx, cy."""
        import pyrealsense2 as rs

        profile: Any = self.rs_profile
        values = profile.get_stream(rs.stream.color).as_video_stream_profile().get_intrinsics()
        return np.array([values.fx, values.fy, values.ppx, values.ppy])

    def depth_unit(self) -> float:
        """One step of its depth, mm."""
        profile: Any = self.rs_profile
        return float(profile.get_device().first_depth_sensor().get_depth_scale() * 1000)

    def newest(self) -> tuple[float, NDArray[np.uint8] | None, NDArray[np.uint16] | None]:
        """When the last pictures came (s of `clock.now`), and both."""
        with self.frame_lock:
            return self.latest_timestamp or float("-inf"), self.latest_color_frame, self.latest_depth_frame


class D435:
    """Pictures as the camera that a policy knows would take them.

    A real camera's tilt and lens are not quite those of the drawing. Its pictures are turned and scaled to the
    drawing's: exact, because a rotation about the camera's own middle needs no depth. What lies outside of the real
    picture is black, and has no depth.

    Args:
        serial_number: of the camera, or its name; auto for the only one.
        view: how the pictures are to look.
        pitch: degrees that it really looks down.
        latency: s between what happens and the picture that shows it.
    """

    def __init__(self, serial_number: str, view: CameraGeometry, pitch: float, latency: float) -> None:
        self._latency = latency
        self._camera = open_camera(serial_number)
        self._unit = self._camera.depth_unit()
        self._maps = view_maps(view, pitch, self._camera.intrinsics())

    def capture(self) -> tuple[NDArray[np.uint8], NDArray[np.uint16]]:
        """Colour and depth of now or later, see `relmm.robot.body.Body.capture`.

        Raises:
            RobotError: no pictures come.
        """
        color, depth = self._fresh()
        return self._maps.color(color), self._maps.depth(depth[..., 0] * self._unit)

    def raw(self) -> tuple[NDArray[np.uint8], NDArray[np.uint16], FloatArray]:
        """As the camera takes them: colour, depth in mm, and its intrinsics (fx, fy, cx, cy)."""
        color, depth = self._fresh()
        return color, np.rint(depth[..., 0] * self._unit).astype(np.uint16), self._camera.intrinsics()

    def _fresh(self) -> tuple[NDArray[np.uint8], NDArray[np.uint16]]:
        """The first pictures that show nothing older than this call."""
        earliest = clock.now() + self._latency
        while True:
            taken, color, depth = self._camera.newest()
            if taken >= earliest and color is not None and depth is not None:
                return color, depth
            if clock.now() > earliest + _LOST_S:
                raise RobotError(NO_PICTURES)
            clock.sleep(_POLL_S)

    @property
    def alive(self) -> bool:
        """Whether pictures come."""
        return clock.now() - self._camera.newest()[0] < _LOST_S

    def close(self) -> None:
        """Stop the camera."""
        if self._camera.is_connected:
            self._camera.disconnect()


class ViewMaps:
    """Where the pixels of the wanted picture are found in the real one.

    Args:
        fine: column and row in the real picture of each pixel of a supersampled one, (rows, columns, 2).
        coarse: the same for each pixel of the wanted one.
        scale: depth in the wanted picture by that in the real one, (rows, columns).
    """

    def __init__(self, fine: NDArray[np.float32], coarse: NDArray[np.float32], scale: FloatArray) -> None:
        self._fine, self._coarse, self._scale = fine, coarse, scale

    def color(self, picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """The wanted picture, uint8 (rows, columns, 3)."""
        fine = cv2.remap(picture, self._fine, _NO_MAP, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
        return np.asarray(cv2.resize(fine, self._scale.shape[::-1], interpolation=cv2.INTER_AREA), np.uint8)

    def depth(self, picture: FloatArray) -> NDArray[np.uint16]:
        """The wanted depth, mm, uint16 (rows, columns); 0 where nothing was measured. Never a mean of near and far."""
        nearest = cv2.remap(
            picture.astype(np.float32), self._coarse, _NO_MAP, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT
        )
        return np.rint(np.minimum(nearest * self._scale, 65_535)).astype(np.uint16)


def view_maps(view: CameraGeometry, pitch: float, intrinsics: FloatArray) -> ViewMaps:
    """How to see through `view` with a camera of intrinsics (fx, fy, cx, cy) that looks down by `pitch` degrees."""
    real = CameraGeometry(position=(0.0, 0.0, 0.0), pitch=pitch, fov=(60.0, 60.0))

    def pixels(size: tuple[int, int]) -> tuple[NDArray[np.float32], FloatArray]:
        wanted = CameraGeometry(view.position, view.pitch, view.fov, size)
        rays = wanted.rays(np.stack(np.meshgrid(np.arange(size[0]), np.arange(size[1])), axis=-1))
        right, down, forward = np.moveaxis(rays @ real.axes.T, -1, 0)
        columns, rows = intrinsics[0] * right / forward + intrinsics[2], intrinsics[1] * down / forward + intrinsics[3]
        return np.stack([columns, rows], axis=-1).astype(np.float32), forward

    coarse, forward = pixels(view.size)
    fine, _ = pixels((view.size[0] * _SUPERSAMPLING, view.size[1] * _SUPERSAMPLING))
    return ViewMaps(fine, coarse, 1.0 / forward)


def open_camera(serial_number: str) -> AlignedRealSense:
    """LeRobot's camera, connected; auto for the only one.

    Raises:
        RobotError: it cannot be; says what to do.
    """
    try:
        number = _only_camera() if serial_number == "auto" else serial_number
        config = RealSenseCameraConfig(number, fps=FPS, width=WIDTH, height=HEIGHT, use_depth=True)
        camera = AlignedRealSense(config)
        camera.connect()
    except ImportError as error:
        raise RobotError(
            "The camera needs pyrealsense2 (pip install 'lerobot_policy_relmm[hardware]'); where there is no wheel of "
            "it for this machine, build librealsense with its Python bindings, or drive the robot from an x86-64 one."
        ) from error
    except (ConnectionError, RuntimeError, ValueError, TimeoutError) as error:
        raise RobotError(
            f"The camera cannot be used ({' '.join(str(error).split())[:160]}): plug it into USB 3, and close other "
            "programs that use it."
        ) from error
    return camera


def _only_camera() -> str:
    import pyrealsense2  # noqa: F401  # LeRobot's search would fail with an AttributeError instead

    numbers = [str(camera["id"]) for camera in RealSenseCamera.find_cameras()]
    if len(numbers) != 1:
        raise RobotError(
            f"{len(numbers)} RealSense cameras are plugged in{': ' if numbers else ''}{', '.join(numbers)}. "
            + ("Say which: --robot.camera_serial=NUMBER." if numbers else "Plug one into USB 3.")
        )
    return numbers[0]
