"""Emulators of the LoCoBot's parts, which test modules import by name, and the whole robot as a process."""

import importlib
import importlib.util
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType

import pytest

HERE = Path(__file__).parent
FAKES = HERE / "fakes"
# The SDK waits for answers in a busy loop; an emulator in the same process has to get its turn.
sys.setswitchinterval(0.0005)
sys.path.insert(0, str(HERE))


@pytest.fixture(autouse=True)
def patience(monkeypatch: pytest.MonkeyPatch) -> None:
    """The SDK allows an answer 34 ms, and the driver its guard 5 s to start; a busy machine may take longer."""
    monkeypatch.setattr("relmm.robot.hardware.kobuki._START_S", 20.0)
    if importlib.util.find_spec("dynamixel_sdk") is not None:
        monkeypatch.setattr("dynamixel_sdk.port_handler.LATENCY_TIMER", 200)


@pytest.fixture
def realsense(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """The fake of pyrealsense2, wherever LeRobot looks for it."""
    monkeypatch.syspath_prepend(str(FAKES))
    monkeypatch.delitem(sys.modules, "pyrealsense2", raising=False)
    fake = importlib.import_module("pyrealsense2")
    from lerobot.cameras.realsense import camera_realsense
    from lerobot.utils import import_utils

    monkeypatch.setitem(import_utils._require_package_cache, "pyrealsense2", True)
    monkeypatch.setattr(camera_realsense, "rs", fake)
    yield fake
    sys.modules.pop("pyrealsense2", None)


class Emulated:
    """An emulated LoCoBot in a process of its own.

    Args:
        folder: of its devices.
        environment: for programs that drive it.
        process: it.
    """

    def __init__(self, folder: Path, environment: dict[str, str], process: subprocess.Popen[str]) -> None:
        self.folder, self.environment, self.process = folder, environment, process
        self.options = [
            "--robot.type=locobot",
            f"--robot.base_port={folder}/kobuki",
            f"--robot.arm_port={folder}/dxl",
            f"--robot.calibration_dir={folder}/calibration",
        ]

    def put(self, x: float, y: float) -> None:
        """Lay the first object down as a person would; m, robot frame."""
        self.process.stdin.write(f"put {x} {y}\n")
        self.process.stdin.flush()
        assert self.process.stdout.readline() == "put\n"


@pytest.fixture
def emulate(tmp_path: Path) -> Iterator[Callable[..., Emulated]]:
    """Start an emulated LoCoBot; it ends with the test."""
    running = []

    def start(room: str = "no_obstacles", num_objects: int = 20, seed: int = 0, speed: float = 0.0) -> Emulated:
        folder = tmp_path / f"locobot_{len(running)}"
        folder.mkdir()
        command = [sys.executable, str(HERE / "emulated_locobot.py"), str(folder), room]
        process = subprocess.Popen(
            [*command, str(num_objects), str(seed), str(speed)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        running.append(process)
        assert process.stdout.readline() == "ready\n"
        path = os.pathsep.join([str(FAKES), os.environ.get("PYTHONPATH", "")])
        environment = {
            **os.environ,
            "PYTHONPATH": path,
            "RELMM_FAKE_REALSENSE": str(folder / "camera"),
            "RELMM_FAKE_REALSENSE_FPS": "10",
        }
        return Emulated(folder, environment, process)

    yield start
    for process in running:
        process.stdin.close()
        try:
            process.wait(10)
        except subprocess.TimeoutExpired:
            process.kill()


@contextmanager
def connected(robot) -> Iterator[object]:
    """A robot for a while."""
    robot.connect()
    try:
        yield robot
    finally:
        robot.disconnect()
