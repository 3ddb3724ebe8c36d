"""As much of librealsense's Python interface as LeRobot's camera and relmm use, in front of pictures from elsewhere.

In one process set `source`; between two, the environment variable RELMM_FAKE_REALSENSE names the socket that
`emulated_locobot.py` listens on.
"""

from __future__ import annotations

import os
import struct
import time
from collections.abc import Callable
from enum import Enum, auto
from multiprocessing.connection import Client, Connection
from types import SimpleNamespace

import numpy as np

# A D435's colour stream of 640x480, by its own calibration; its middle is never quite that of the picture.
INTRINSICS = SimpleNamespace(width=640, height=480, fx=615.0, fy=615.3, ppx=322.5, ppy=238.5)
SERIAL = "821212062500"
_POLL_S = 0.001


class stream(Enum):
    color = auto()
    depth = auto()


class format(Enum):
    rgb8 = auto()
    z16 = auto()


class camera_info(Enum):
    name = "Intel RealSense D435"
    serial_number = SERIAL
    firmware_version = "5.16.0.1"
    usb_type_descriptor = "3.2"
    physical_port = "2-1"
    product_id = "0B07"
    product_line = "D400"


class option(Enum):
    exposure = auto()


class _Source:
    """Pictures through a socket."""

    def __init__(self) -> None:
        self._connection: Connection | None = None

    def __call__(self) -> tuple[np.ndarray, np.ndarray]:
        if self._connection is None:
            self._connection = Client(os.environ["RELMM_FAKE_REALSENSE"], "AF_UNIX")
        try:
            self._connection.send(None)
            global taken
            (taken,) = struct.unpack("d", self._connection.recv_bytes())
            height, width = INTRINSICS.height, INTRINSICS.width
            rgb = np.frombuffer(self._connection.recv_bytes(), np.uint8).reshape(height, width, 3)
            depth = np.frombuffer(self._connection.recv_bytes(), np.uint16).reshape(height, width)
        except (EOFError, OSError) as error:
            self._connection = None
            raise RuntimeError("the device has been disconnected") from error
        return rgb, depth


source: Callable[[], tuple[np.ndarray, np.ndarray]] = _Source()  # colour, and depth in mm; fails when unplugged
fps = float(os.environ.get("RELMM_FAKE_REALSENSE_FPS", "30"))
plugged = 1  # how many cameras there are
started = 0  # pipelines that run
now: Callable[[], float] = time.monotonic  # the robot's time
taken = 0.0  # when the newest picture from a socket was taken, in the robot's time
still_s = float("inf")  # of our time after which the same picture comes again: the robot's time stands still


class device:
    def __init__(self, number: int = 0) -> None:
        self._number = number

    def get_info(self, info: camera_info) -> str:
        return str(int(SERIAL) + self._number) if info is camera_info.serial_number else info.value

    def query_sensors(self) -> list[object]:
        return []

    def first_depth_sensor(self) -> SimpleNamespace:
        return SimpleNamespace(get_depth_scale=lambda: 0.001)

    def hardware_reset(self) -> None:
        pass


class context:
    def query_devices(self) -> list[device]:
        return [device(number) for number in range(plugged)]


class config:
    def __init__(self) -> None:
        self.serial = ""
        self.streams: dict[stream, tuple[object, ...]] = {}

    def enable_device(self, serial: str) -> None:
        self.serial = serial

    def enable_stream(self, kind: stream, *settings: object) -> None:
        self.streams[kind] = settings


class pipeline_profile:
    def __init__(self, streams: dict[stream, tuple[object, ...]]) -> None:
        self._streams = streams

    def get_stream(self, kind: stream) -> SimpleNamespace:
        video = SimpleNamespace(
            fps=lambda: 30, width=lambda: 640, height=lambda: 480, get_intrinsics=lambda: INTRINSICS
        )
        assert kind in self._streams
        return SimpleNamespace(as_video_stream_profile=lambda: video)

    def get_device(self) -> device:
        return device()


class _Frame:
    def __init__(self, data: np.ndarray) -> None:
        self._data = data

    def get_data(self) -> np.ndarray:
        return self._data


class composite_frame:
    """Both pictures; the depth is that of another viewpoint until it is aligned."""

    def __init__(self, rgb: np.ndarray, depth: np.ndarray, aligned: bool = False) -> None:
        self.rgb, self.depth, self.aligned = rgb, depth, aligned

    def get_color_frame(self) -> _Frame:
        return _Frame(self.rgb)

    def get_depth_frame(self) -> _Frame:
        return _Frame(self.depth if self.aligned else np.roll(self.depth, 40, axis=1))


class align:
    def __init__(self, to: stream) -> None:
        assert to is stream.color

    def process(self, frames: composite_frame) -> composite_frame:
        return composite_frame(frames.rgb, frames.depth, aligned=True)


class pipeline:
    def __init__(self) -> None:
        self._next = 0.0
        self._running = False

    def start(self, settings: config) -> pipeline_profile:
        global started
        if not plugged or settings.serial not in [
            d.get_info(camera_info.serial_number) for d in context().query_devices()
        ]:
            raise RuntimeError("No device connected")
        assert settings.streams[stream.color] == (640, 480, format.rgb8, 30)
        assert settings.streams[stream.depth] == (640, 480, format.z16, 30)
        self._running = True
        started += 1
        return pipeline_profile(settings.streams)

    def try_wait_for_frames(self, timeout_ms: int = 5000) -> tuple[bool, composite_frame | None]:
        patience = time.monotonic() + still_s
        while now() < self._next and time.monotonic() < patience:
            time.sleep(_POLL_S)
        self._next = now() + 1 / fps
        try:
            return True, composite_frame(*source())
        except RuntimeError:
            time.sleep(0.05)
            return False, None

    def stop(self) -> None:
        global started
        started -= self._running
        self._running = False
