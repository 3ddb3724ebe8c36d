"""Emulators of the LoCoBot's parts, which test modules import by name, and the whole robot as a process."""

import importlib
import importlib.util
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from itertools import count
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

# The SDK waits for answers in a busy loop; an emulator in the same process has to get its turn.
sys.setswitchinterval(0.0005)
sys.path.insert(0, str(Path(__file__).parent))

from emulated_process import FAKES, Emulated  # noqa: E402


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


@pytest.fixture
def emulate(tmp_path: Path) -> Iterator[Callable[..., Emulated]]:
    """Start an emulated LoCoBot, see `Emulated`; it ends with the test."""
    with ExitStack() as running:
        numbers = count()
        yield lambda **settings: running.enter_context(Emulated(tmp_path / f"locobot_{next(numbers)}", **settings))


@pytest.fixture
def live_in_emulator(realsense: ModuleType, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[Emulated], Any]]:
    """Connect to an emulated LoCoBot in this process, and live in its time until the test ends."""
    from emulated_time import SharedTime, live_in

    from relmm.robot.hardware.config_locobot import LocobotConfig
    from relmm.robot.hardware.locobot import Locobot

    with ExitStack() as connections:

        def connect(emulated: Emulated) -> Locobot:
            live_in(SharedTime(emulated.folder / "time"), monkeypatch.setattr)
            monkeypatch.setenv("RELMM_FAKE_REALSENSE", emulated.environment["RELMM_FAKE_REALSENSE"])
            monkeypatch.setattr(realsense, "fps", 10.0)
            config = LocobotConfig(
                base_port=str(emulated.folder / "kobuki"),
                arm_port=str(emulated.folder / "dxl"),
                calibration_dir=emulated.folder / "calibration",
            )
            return connections.enter_context(Locobot(config))

        yield connect


@contextmanager
def connected(robot) -> Iterator[object]:
    """A robot for a while."""
    robot.connect()
    try:
        yield robot
    finally:
        robot.disconnect()
